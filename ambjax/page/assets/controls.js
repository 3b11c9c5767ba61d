"use strict";
// The controls: sliders with typed numbers, presets, and the case file with the chosen numbers.
const STEPS = 1000;
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (name) => document.getElementById(name);

// Parameters of each preset. In the data, infinite ones are strings.
const presets = data.presets.map(({ P }) => Float64Array.from(P, Number));
let base = 0;
let values = data.sliders.map(({ parameter }) => presets[0][parameter]);

function parameters() {
  const P = Float64Array.from(presets[base]);
  data.sliders.forEach(({ parameter }, k) => { P[parameter] = values[k]; });
  return P;
}

function toPosition(slider, x) {
  const { low, high, log } = slider;
  const share = log ? Math.log(x / low) / Math.log(high / low) : (x - low) / (high - low);
  return Math.round(STEPS * Math.min(Math.max(share, 0), 1));
}

// The value at a position of a slider, rounded: to a whole number, to a whole sample, or to a few digits.
function toValue(slider, position) {
  const { low, high, log, whole, grid } = slider, share = position / STEPS;
  const x = log ? low * (high / low) ** share : low + share * (high - low);
  if (whole) return Math.round(x);
  if (grid) return onGrid(x);
  const digits = Math.min(Math.max(log ? 4 : Math.ceil(Math.log10((Math.abs(x) || 1) / (high - low))) + 4, 1), 15);
  return Math.abs(x) < 1e-9 * (high - low) ? 0 : Number(x.toPrecision(digits));
}

// A time in s, rounded to a whole sample.
function onGrid(x) { return Number((Math.round(x / data.period) * data.period).toPrecision(12)); }

// The shortest text of a number, with `digits` significant digits if they are given.
function text(x, digits) {
  const y = digits ? Number(x.toPrecision(digits)) : x, plain = String(y), short = y.toExponential().replace("e+", "e");
  return plain.length > Math.max(short.length, 8) ? short : plain;
}

// The message for a typed number that is not allowed; empty if it is allowed.
function fault(slider, x) {
  const { least, most, open, whole } = slider;
  if (!Number.isFinite(x)) return "Type a number, for example 2.5e-3.";
  if (least !== null && (open ? x <= least : x < least)) return `It must be ${open ? "above" : "at least"} ${least}.`;
  if (most !== null && x > most) return `It must be at most ${most}.`;
  return whole && x !== Math.round(x) ? "It must be a whole number." : "";
}

function element(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

// Build a slider with its label and typed number. `k`: its index; `changed`: called after each change.
function addSlider(slider, k, changed) {
  const unit = slider.unit ? ` in ${slider.unit}` : "";
  const range = element("input", { type: "range", min: 0, max: STEPS, step: 1, id: `range-${k}`, "data-path": slider.path });
  const typed = element("input", { type: "text", inputmode: "decimal", id: `number-${k}`, autocomplete: "off", "aria-describedby": `fault-${k}` });
  const label = element("label", { for: `number-${k}`, title: slider.doc }, ...slider.path.split(/(?<=\.)/).flatMap((word) => [word, element("wbr", {})]), element("small", {}, unit));
  const why = element("span", { class: "fault", id: `fault-${k}` });
  range.setAttribute("aria-label", `${slider.path}${unit}`);
  const box = element("div", { class: "number" }, label, typed, range, why);
  range.addEventListener("input", () => { values[k] = toValue(slider, Number(range.value)); show(k); changed(); });
  typed.addEventListener("change", () => {
    const x = typed.value.trim() === "" ? NaN : Number(typed.value), reason = fault(slider, x);
    why.textContent = reason;
    typed.setAttribute("aria-invalid", String(reason !== ""));
    if (reason === "") { values[k] = slider.grid ? onGrid(x) : x; show(k); changed(); }
  });
  box.show = (x) => {
    typed.value = slider.whole || text(x).length < 10 ? text(x) : text(x, 6);
    typed.title = text(x);
    typed.setAttribute("aria-invalid", "false");
    why.textContent = "";
    range.value = toPosition(slider, x);
    range.setAttribute("aria-valuetext", `${text(x)} ${slider.unit}`);
    box.classList.toggle("moved", x !== presets[base][slider.parameter]);
  };
  return box;
}

const boxes = [];
function show(k) { boxes[k].show(values[k]); }

function buildControls(changed) {
  data.groups.forEach(([prefix, title], number) => {
    const members = data.sliders.map((slider, k) => [slider, k]).filter(([slider]) => slider.path.startsWith(prefix));
    if (!members.length) return;
    const group = element("details", number < 1 ? { open: "" } : {}, element("summary", {}, `${title} (${members.length})`));
    for (const [slider, k] of members) group.append((boxes[k] = addSlider(slider, k, changed)));
    byId("groups").append(group);
  });
  data.presets.forEach(({ name }, k) => byId("preset").append(element("option", { value: k }, name)));
  const restore = () => {
    base = Number(byId("preset").value);
    values = data.sliders.map(({ parameter }) => presets[base][parameter]);
    boxes.forEach((_, k) => show(k));
    changed();
  };
  byId("preset").addEventListener("change", restore);
  byId("reset").addEventListener("click", restore);
  boxes.forEach((_, k) => show(k));
}

// A number as TOML. A float needs a point or an exponent.
function toml(x, whole) {
  const shortest = text(x);
  return whole ? String(x) : /[.e]/.test(shortest) ? shortest : `${shortest}.0`;
}

// The case file of the preset with the values of the sliders, as `filled` in case_text.py writes it.
function caseFile() {
  const own = (k) => presets[base][data.sliders[k].parameter], moved = (k) => values[k] !== own(k);
  const lines = data.presets[base].lines.filter(([, only]) => !only.length || only.some(moved));
  const part = (one) => {
    if (typeof one === "string") return one;
    const [k, written] = one;
    return written && !moved(k) ? written : toml(values[k], data.sliders[k].whole);
  };
  return lines.map(([parts]) => parts.map(part).join("")).join("\n");
}

function buildTexts() {
  const open = (button, label, text) => {
    byId("written").hidden = false;
    for (const id of ["write", "tune"]) byId(id).setAttribute("aria-expanded", String(id === button));
    byId("text-label").textContent = label;
    byId("text").value = text;
    byId("save").href = URL.createObjectURL(new Blob([caseFile()], { type: "text/plain" }));
    byId("text").focus();
  };
  byId("save").download = data.from;
  byId("write").addEventListener("click", () => open("write", "Case file with these numbers", caseFile()));
  byId("tune").addEventListener("click", () => open("tune", "Save the case file, then run", data.command));
}
