// The drawing of the machine at one instant: the rotor between its two magnets, and the currents of the coils.
const SVG = "http://www.w3.org/2000/svg";

function shape(tag, attributes, text) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text) made.textContent = text;
  return made;
}

// Draw the magnets. Return a function that shows one instant: z, r, gap s0 and clearance in m, both currents and bias i0 in A.
function machine(parent) {
  const svg = shape("svg", { viewBox: "0 -4 360 308", role: "img", "aria-label": "Rotor in its gap" });
  const core = { fill: "#d7dbe0", stroke: "#555", "stroke-width": 1.5 }, middle = 150, gap = 45, half = 38;
  const coil = (y) => shape("rect", { x: 130, y, width: 100, height: 16, rx: 3, stroke: "#7a3b00", "stroke-width": 1.5 });
  const upper = coil(28), lower = coil(256);
  const stops = [1, -1].map(() => shape("line", { x1: 70, x2: 290, stroke: "#a30000", "stroke-dasharray": "5 4" }));
  const rotor = shape("rect", { x: 60, width: 240, height: 2 * half, rx: 4, fill: "#8aa4c0", stroke: "#2c4a68", "stroke-width": 1.5 });
  const target = shape("line", { x1: 40, x2: 320, stroke: "#1c1c1c", "stroke-dasharray": "2 4" });
  const words = [12, 298, middle + 5].map((y) =>
    shape("text", { x: 180, y, "text-anchor": "middle", "font-size": 13, fill: "#1c1c1c" }));
  const top = shape("path", { d: `M60 20H300V${middle - half - gap}H270V48H90V${middle - half - gap}H60Z`, ...core });
  const bottom = shape("path", { d: `M60 280H300V${middle + half + gap}H270V252H90V${middle + half + gap}H60Z`, ...core });
  svg.append(top, bottom, upper, lower, ...stops, rotor, target, ...words);
  parent.append(svg);
  return ({ z, r, upperA, lowerA, s0, i0, clearance }) => {
    const y = (x) => middle - (x / s0) * gap;
    rotor.setAttribute("y", y(Math.max(Math.min(z, s0), -s0)) - half);
    for (const [line, x] of [[target, r]]) for (const end of ["y1", "y2"]) line.setAttribute(end, y(x));
    stops.forEach((line, k) => {
      const side = k === 0 ? 1 : -1, at = y(side * clearance) - side * half;
      for (const end of ["y1", "y2"]) line.setAttribute(end, at);
    });
    const paint = (one, i) => one.setAttribute("fill", `hsl(28 90% ${Math.round(92 - 50 * Math.min(Math.abs(i) / (2 * i0), 1))}%)`);
    paint(upper, upperA);
    paint(lower, lowerA);
    words[0].textContent = `upper coil ${upperA.toFixed(3)} A`;
    words[1].textContent = `lower coil ${lowerA.toFixed(3)} A`;
    words[2].textContent = `z = ${(1e6 * z).toFixed(2)} µm`;
    svg.setAttribute("aria-label", `Rotor at ${(1e6 * z).toFixed(2)} micrometres; ${words[0].textContent}; ${words[1].textContent}`);
  };
}
