// The worker. It computes the newest request: first the nominal loop, then the members in time slices, so that it sees new
// requests soon.
let setup = null, latest = null, busy = false, known = new Map();
const channel = new MessageChannel();
let next = () => {};
channel.port1.onmessage = () => next();

// Run `task` after the messages that wait.
function soon(task) {
  next = task;
  channel.port2.postMessage(0);
}

// The normal numbers of a member, computed once for each seed.
function noiseOf(seed, member) {
  const key = `${seed} ${member}`;
  if (known.size > 256) known = new Map();
  if (!known.has(key)) known.set(key, normals(seed, member, setup.samples));
  return known.get(key);
}

// The functions of the loop. Those for the delay of the case are faster, those for any delay slower.
function functionsFor(P) {
  return P[setup.delay] === setup.presets[0].P[setup.delay] ? [makeLoop, makeMember] : [any_makeLoop, any_makeMember];
}

// Rows, status code and metrics of the nominal run.
function simulated(P) {
  const { samples, states } = setup, width = setup.signals.length, W = noiseOf(P[setup.seed], 0), S = startLoop(P, W, new Float64Array(states));
  const rows = new Float64Array(samples * width);
  functionsFor(P)[0](P)(S, 0, samples, W, rows);
  return { rows, code: S[setup.lost], metrics: Array.from(loopMetrics(P, S, new Float64Array(setup.metrics.length))) };
}

function answer(job) {
  const began = performance.now(), P = job.P, { rows, metrics, code } = simulated(P), { samples, period } = setup, width = setup.signals.length;
  const error = new Float64Array(samples);
  for (let n = 0; n < samples; n++) error[n] = rows[n * width] - rows[n * width + 2];
  const from = Math.min(Math.floor(setup.settle / period), Math.floor(samples / 2));
  const S = sensitivity(P, setup.linear, period, P[setup.delay]);
  const found = { id: job.id, rows, metrics, code, P, spectrum: spectrum(error, from, period), S };
  postMessage({ kind: "nominal", ...found, took: performance.now() - began }, [rows.buffer]);
}

// Parameters of a member. Its drawn values multiply the page's values, or replace them.
function memberParameters(P, member) {
  const own = Float64Array.from(P);
  for (const [index, factor, values] of setup.members.rows) own[index] = factor ? P[index] * values[member] : values[member];
  return own;
}

function study(job) {
  const { samples } = setup, bins = Math.min(samples, 400), low = new Float64Array(bins).fill(NaN), high = low.slice();
  const alive = new Float64Array(bins), began = performance.now();
  return { job, member: 0, bins, low, high, alive, kept: 0, began };
}

// Simulate the next member and include its error in the envelope.
function addMember(state) {
  const { samples } = setup, P = memberParameters(state.job.P, state.member), W = noiseOf(P[setup.seed], state.member);
  const S = startLoop(P, W, new Float64Array(setup.states)), rows = new Float64Array(3 * samples);
  functionsFor(P)[1](P)(S, 0, samples, W, rows);
  for (let n = 0; n < samples; n++) {
    const bin = Math.floor((n * state.bins) / samples), e = rows[3 * n] - rows[3 * n + 2];
    if (rows[3 * n + 1] === 0) break;
    if (!(e >= state.low[bin])) state.low[bin] = e;
    if (!(e <= state.high[bin])) state.high[bin] = e;
    if (n === samples - 1 || Math.floor(((n + 1) * state.bins) / samples) > bin) state.alive[bin] += 1;
  }
  state.kept += S[setup.lost] === 0 ? 1 : 0;
  state.member += 1;
}

// Simulate members for 12 ms, unless a new request waits.
function slice(state) {
  if (latest !== null) return work();
  const until = performance.now() + 12;
  while (state.member < setup.members.count && performance.now() < until) addMember(state);
  if (state.member < setup.members.count) return soon(() => slice(state));
  const { low, high, alive, kept, began, job } = state;
  if (job.id === 1) soon(() => warmed(job.P, 4));
  else busy = false;
  postMessage({ kind: "members", id: job.id, low, high, alive, kept, count: setup.members.count, took: performance.now() - began });
}

// Run the loop a few times while the page is idle, so that the browser compiles it before the first drag.
function warmed(P, times) {
  if (latest !== null) return work();
  simulated(P);
  if (times > 1) return soon(() => warmed(P, times - 1));
  busy = false;
}

function work() {
  const job = latest;
  latest = null;
  answer(job);
  soon(() => slice(study(job)));
}

self.onmessage = ({ data }) => {
  if (data.setup) {
    setup = data.setup;
    return;
  }
  latest = data;
  if (!busy) {
    busy = true;
    soon(work);
  }
};
