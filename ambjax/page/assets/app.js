// The page. It sends the parameters to the worker after every change, and shows the newest results.
const state = { sent: 0, shown: 0, members: 0, began: new Map(), timing: { nominal: [], members: [] }, run: null, metrics: {} };
window.ambjax = { state, data, parameters, caseFile };

// Read an array of rows: `of(name)` returns a signal [samples]; `error` is z - r in m.
function readRun(array) {
  const width = data.signals.length, length = array.length / width, columns = {};
  const of = (name) => {
    const k = data.signals.indexOf(name);
    return (columns[name] ??= Float64Array.from({ length }, (_, n) => array[n * width + k]));
  };
  return { length, of, error: of("z").map((z, n) => z - of("r")[n]) };
}

function showMetrics(metrics) {
  state.metrics = Object.fromEntries(data.metrics.map((name, k) => [name, metrics[k]]));
  data.metrics.forEach((name, k) => {
    const x = metrics[k], flag = name === "lost" || name === "stalled";
    const shown = flag ? String(Boolean(x)) : Number.isFinite(x) ? text(x, 6) : "never";
    if (cells[k].textContent !== shown) cells[k].textContent = shown;
  });
}

// Cells for the values of the metrics, in new rows of the table.
const cells = data.metrics.map((name) => {
  const cell = element("td", {});
  byId("metrics").tBodies[0].append(element("tr", {}, element("th", { scope: "row" }, name), cell, element("td", {}, data.units[name] || "")));
  return cell;
});

// Shown until the newest run has been computed. The first run has no older results behind it.
function showComputing() {
  byId("status").textContent = `Computing ${data.samples} samples ...`;
  byId("status").classList.remove("lost");
  byId("results").classList.add("stale");
}

function showStatus({ lost, lost_at_s: at, max_abs_u_V: u }, code) {
  const words = lost ? `The rotor is lost at ${at.toPrecision(4)} s: ${data.statuses[code]}.` : `The rotor is held. Largest voltage: ${u.toPrecision(4)} V.`;
  byId("status").textContent = words;
  byId("status").classList.toggle("lost", Boolean(lost));
  byId("results").classList.remove("waiting", "stale");
}

function showMachine(draw) {
  if (state.run === null) return;
  const { run, P } = state, n = Math.round((Number(byId("time").value) / 1000) * (run.length - 1));
  const place = (path) => P[data.places[path]], s0 = place("plant.s_0"), at = (name) => run.of(name)[n];
  const clearance = "run.clearance" in data.places ? place("run.clearance") : 0.9 * s0;
  byId("at").textContent = `${(n * data.period).toPrecision(4)} s`;
  byId("time").setAttribute("aria-valuetext", byId("at").textContent);
  draw({ z: at("z"), r: at("r"), upperA: at("i_1"), lowerA: at("i_2"), s0, i0: place("plant.i_0"), clearance });
}

async function begin() {
  const code = JSON.parse(byId("worker").textContent);
  const worker = new Worker(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
  const plots = await buildPlots(byId("plots")), draw = machine(byId("drawing"));
  const request = () => {
    state.sent += 1;
    const id = state.sent;
    state.began.set(id, performance.now());
    setTimeout(() => { if (state.shown < id) showComputing(); }, 400);
    worker.postMessage({ id, P: parameters() });
  };
  worker.onerror = (event) => { byId("status").textContent = `The worker failed: ${event.message}`; };
  worker.onmessage = ({ data: answer }) => {
    if (answer.id < state.sent && answer.kind === "members") return;
    const began = state.began.get(answer.id);
    if (answer.kind === "members") {
      plots.members(answer);
      state.members = answer.id;
      requestAnimationFrame(() => state.timing.members.push([performance.now() - began, answer.took]));
      state.envelope = answer;
      return;
    }
    state.P = answer.P;
    state.run = readRun(answer.rows);
    state.answer = answer;
    showMetrics(answer.metrics);
    showStatus(state.metrics, answer.code);
    plots.nominal(state.run, answer);
    showMachine(draw);
    state.shown = answer.id;
    requestAnimationFrame(() => setTimeout(() => state.timing.nominal.push([performance.now() - began, answer.took]), 0));
  };
  worker.postMessage({ setup: data });
  buildControls(request);
  buildTexts();
  byId("time").addEventListener("input", () => showMachine(draw));
  plots.onZoom();
  request();
}

begin();
