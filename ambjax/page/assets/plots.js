// The plots, drawn with Bokeh. All plots over time share a range. Each draws the extremes of the samples in COLUMNS columns.
const COLUMNS = 300;
const COLORS = ["#0b5cad", "#c2571a", "#2f7d32", "#6b3fa0"];

// Plots over time: title, axis, unit and lines [name, function of a run, whether the line is hidden at first].
const micro = (x) => 1e6 * x;
const TIME_PLOTS = [
  { id: "error", title: "Error z − r", y: "error in µm", unit: "µm", lines: [["z − r", (run) => run.error.map(micro)]] },
  { id: "position", title: "Position", y: "position in µm", unit: "µm", lines: [["z", (run) => run.of("z").map(micro)], ["reference r", (run) => run.of("r").map(micro)], ["reading of z", (run) => run.of("z_measured").map(micro), true]] },
  { id: "currents", title: "Currents of the coils", y: "current in A", unit: "A", lines: [["upper coil", (run) => run.of("i_1")], ["lower coil", (run) => run.of("i_2")]] },
  { id: "voltage", title: "Voltage", y: "voltage in V", unit: "V", lines: [["u", (run) => run.of("u")], ["mean of each sample", (run) => run.of("u_mean"), true]] },
];

// Indices of the samples to draw from index `from` to `to`: the lowest and the highest value of each column, in order.
function thinned(y, from, to) {
  const count = to - from;
  if (count <= 2 * COLUMNS) return Array.from({ length: count }, (_, k) => from + k);
  const found = [];
  for (let c = 0; c < COLUMNS; c++) {
    const first = from + Math.floor((c * count) / COLUMNS), last = from + Math.floor(((c + 1) * count) / COLUMNS);
    let low = first, high = first;
    for (let n = first + 1; n < last; n++) {
      if (y[n] < y[low]) low = n;
      if (y[n] > y[high]) high = n;
    }
    found.push(Math.min(low, high), ...(low === high ? [] : [Math.max(low, high)]));
  }
  return found;
}

// Build a plot. `x`: label of the horizontal axis; `range`: its range; `heights`: range of y; `more`: a function that adds parts.
function addPlot({ id, title, y, unit, lines, x = "time in s", range = null, heights = null, log = false, more }) {
  const ends = log ? [1, 10] : [0, data.samples * data.period];
  const drawn = [], sources = lines.map(() => new Bokeh.ColumnDataSource({ data: { x: ends, y: log ? [1e-3, 1] : [0, 0] } }));
  const axes = log ? { x_axis_type: "log", y_axis_type: "log" } : { x_range: range };
  const figure = Bokeh.Plotting.figure({ height: 230, sizing_mode: "stretch_width", tools: "pan,box_zoom,wheel_zoom,reset,save", x_axis_label: x, y_axis_label: y, ...axes, ...(heights ? { y_range: heights } : {}) });
  figure.toolbar.logo = null;
  if (more) more(figure);
  lines.forEach(([name, , hidden], k) => {
    const line = figure.line({ field: "x" }, { field: "y" }, { source: sources[k], color: COLORS[k], line_width: 1.4 });
    line.visible = !hidden;
    drawn.push(line);
    const tip = log ? `${name}: @y{0.000e} ${unit} at @x{0.00} Hz` : `${name}: @y{0.0000} ${unit} at @x{0.00000} s`;
    figure.add_tools(new Bokeh.HoverTool({ renderers: [line], tooltips: [["", tip]], mode: "mouse", line_policy: "nearest" }));
  });
  if (lines.length > 1) {
    const items = lines.map(([name], k) => new Bokeh.LegendItem({ label: name, renderers: [drawn[k]] }));
    figure.add_layout(new Bokeh.Legend({ items, orientation: "horizontal", click_policy: "hide", border_line_color: null, label_text_font_size: "11px", padding: 0, margin: 0 }), "above");
  }
  return { id, title, figure, sources, lines, drawn };
}

// Show all plots, each in its own section of the page.
async function showPlots(parent, plots) {
  const all = new Bokeh.Document(), roots = plots.map(({ id, title, figure }) => {
    all.add_root(figure);
    const box = element("div", { role: "img", "aria-label": title });
    parent.append(element("section", { class: "plot", id: `plot-${id}` }, element("h2", {}, title), box));
    return box;
  });
  await Bokeh.embed.add_document_standalone(all, element("div", {}), roots);
}

// Run `task`, which draws a plot: now if the plot is visible, else when it becomes visible or after 300 ms without a change.
const waiting = new Map();
let idle = 0;
function refresh(plot, task) {
  waiting.set(plot, task);
  if (plot.inWindow) drawWaiting(plot);
  clearTimeout(idle);
  idle = setTimeout(() => [...waiting.keys()].forEach(drawWaiting), 300);
}

function drawWaiting(plot) {
  const task = waiting.get(plot);
  waiting.delete(plot);
  if (task) task();
}

function watchWindow(plots) {
  const boxes = new Map(plots.map((plot) => [byId(`plot-${plot.id}`), plot]));
  const watcher = new IntersectionObserver((entries) => entries.forEach(({ target, isIntersecting }) => {
    boxes.get(target).inWindow = isIntersecting;
    if (isIntersecting) drawWaiting(boxes.get(target));
  }));
  boxes.forEach((_, box) => watcher.observe(box));
}

function retitle({ id }, title) { document.querySelector(`#plot-${id} h2`).textContent = title; }

// Build every plot, and return functions that draw a nominal run and an ensemble.
async function buildPlots(parent) {
  const range = new Bokeh.Range1d({ start: 0, end: data.samples * data.period });
  const timed = TIME_PLOTS.map((one) => addPlot({ ...one, range }));
  const band = new Bokeh.ColumnDataSource({ data: { x: [0, 1], low: [0, 0], high: [0, 0] } });
  const shade = (figure) => figure.varea({ field: "x" }, { field: "low" }, { field: "high" }, { source: band, color: COLORS[0], alpha: 0.2 });
  const members = addPlot({ id: "members", title: "Envelope of the members", y: "error in µm", unit: "µm", lines: [["highest", null], ["lowest", null]], range, more: shade });
  const hertz = { x: "frequency in Hz", log: true };
  const spectrumPlot = addPlot({ id: "spectrum", title: "Spectrum of the error", y: "amplitude in µm", unit: "µm", lines: [["z − r", null]], ...hertz });
  const zones = (figure) => data.linear.zones.forEach((limit, k) => figure.add_layout(new Bokeh.Span({ location: limit, dimension: "width", line_color: ["#2f7d32", "#b07a00", "#a30000"][k], line_dash: "dashed" })));
  const sensitivityPlot = addPlot({ id: "sensitivity", title: "Sensitivity |S|", y: "|S|", unit: "", lines: [["|S|", null]], heights: new Bokeh.Range1d({ start: 0.01, end: 10 }), more: zones, ...hertz });
  await showPlots(parent, [...timed, members, spectrumPlot, sensitivityPlot]);
  parent.append(byId("machine"));
  byId("plot-members").classList.add("pending");
  watchWindow([...timed, members, spectrumPlot, sensitivityPlot]);
  let shown = null;
  const drawTimes = () => {
    if (shown === null) return;
    const { start, end } = range, { t, columns } = shown, zoomed = shown.zoomed;
    const at = (x, other) => (zoomed && Number.isFinite(x) ? Math.min(Math.max(Math.round(x / data.period), 0), t.length) : other);
    const from = at(start, 0), to = Math.max(at(end, t.length), from + 2);
    timed.forEach((plot, k) => refresh(plot, () => columns[k].forEach((y, j) => {
      if (!plot.drawn[j].visible) return;
      const chosen = thinned(y, from, Math.min(to, t.length));
      plot.sources[j].data = { x: chosen.map((n) => t[n]), y: chosen.map((n) => y[n]) };
    })));
  };
  const finite = (xs) => xs.map((x) => (Number.isFinite(x) && x > 0 ? x : NaN));
  return {
    nominal(run, { spectrum, S }) {
      const zoomed = shown !== null && shown.zoomed;
      const columns = timed.map(({ lines }) => lines.map(([, of]) => of(run)));
      shown = { t: Array.from(run.error, (_, n) => n * data.period), columns, zoomed };
      drawTimes();
      retitle(members, "Envelope of the members: computing ...");
      byId("plot-members").classList.add("stale");
      refresh(spectrumPlot, () => { spectrumPlot.sources[0].data = { x: spectrum.f, y: finite(spectrum.amplitude.map(micro)) }; });
      refresh(sensitivityPlot, () => {
        sensitivityPlot.sources[0].data = S === null ? { x: [1, 10], y: [NaN, NaN] } : { x: S.f, y: finite(S.size) };
        const top = data.linear.zones[2] * 1.5, sizes = S === null ? [1] : S.size;
        sensitivityPlot.figure.y_range.setv({ start: Math.max(Math.min(...sizes) / 2, 1e-6), end: Math.max(top, ...sizes) });
      });
      const atEnd = S !== null && [S.f[0], S.f[S.f.length - 1]].some((end) => Math.abs(S.frequency / end - 1) < 1e-4);
      const unstable = S === null ? "no equilibrium" : `${atEnd ? "largest at an end of the range," : "peak"} ${S.peak.toPrecision(4)} at ${S.frequency.toPrecision(4)} Hz, zone ${S.zone}${S.stable ? "" : ", unstable"}`;
      retitle(sensitivityPlot, `Sensitivity |S|: ${unstable}`);
    },
    members({ low, high, kept, count }) {
      const length = low.length, x = Array.from(low, (_, k) => ((k + 0.5) / length) * data.samples * data.period);
      const lows = Array.from(low, micro), highs = Array.from(high, micro);
      refresh(members, () => {
        members.sources[0].data = { x, y: highs };
        members.sources[1].data = { x, y: lows };
        band.data = { x, low: lows, high: highs };
      });
      retitle(members, `Envelope: ${kept} of ${count} members are held`);
      byId("plot-members").classList.remove("stale", "pending");
    },
    onZoom() {
      let waiting = false;
      const redraw = () => { waiting = false; drawTimes(); };
      const moved = () => {
        if (shown === null) return;
        shown.zoomed = range.end - range.start < 0.98 * data.samples * data.period;
        if (!waiting) { waiting = true; setTimeout(redraw, 100); }
      };
      range.properties.start.change.connect(moved);
      timed.forEach(({ drawn }) => drawn.forEach((line) => line.properties.visible.change.connect(drawTimes)));
    },
  };
}
