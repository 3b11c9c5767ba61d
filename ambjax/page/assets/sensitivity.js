// The linear loop: its equilibrium by Newton's method, the map of one sample, and |S|, as ambjax.linear computes them.

// Solve A x = b for a real matrix (rows of numbers), by Gaussian elimination with scaled partial pivoting.
// A row of zeros belongs to a state that never changes: its equation is x = 0.
function solveReal(A, b) {
  const n = b.length, M = A.map((row, i) => [...row, b[i]]);
  for (let i = 0; i < n; i++) {
    const size = M[i].slice(0, n).reduce((a, x) => Math.max(a, Math.abs(x)), 0);
    M[i] = size > 0 ? M[i].map((x) => x / size) : M[i].map((_, k) => Number(k === i));
  }
  for (let k = 0; k < n; k++) {
    let p = k;
    for (let i = k + 1; i < n; i++) if (Math.abs(M[i][k]) > Math.abs(M[p][k])) p = i;
    [M[k], M[p]] = [M[p], M[k]];
    for (let i = k + 1; i < n; i++) {
      const f = M[i][k] / M[k][k];
      if (f !== 0) for (let j = k; j <= n; j++) M[i][j] -= f * M[k][j];
    }
  }
  const x = new Array(n).fill(0);
  for (let k = n - 1; k >= 0; k--) {
    let total = M[k][n];
    for (let j = k + 1; j < n; j++) total -= M[k][j] * x[j];
    x[k] = total / M[k][k];
  }
  return x;
}

// The product of two matrices.
function times(A, B) {
  return A.map((row) => B[0].map((_, j) => row.reduce((total, x, k) => total + x * B[k][j], 0)));
}

// exp(A h) and the integral of exp(A s) B over s from 0 to h, for a vector B, by scaling and squaring.
function held(A, B, h) {
  const n = A.length + 1, M = A.map((row, i) => [...row.map((x) => x * h), B[i] * h]);
  M.push(new Array(n).fill(0));
  const size = M.reduce((a, row) => Math.max(a, row.reduce((t, x) => t + Math.abs(x), 0)), 0);
  const halvings = Math.max(0, Math.ceil(Math.log2(size || 1)) + 4), small = M.map((row) => row.map((x) => x / 2 ** halvings));
  let term = small.map((_, i) => small.map((__, j) => (i === j ? 1 : 0))), total = term.map((row) => [...row]);
  for (let k = 1; k <= 14; k++) {
    term = times(term, small).map((row) => row.map((x) => x / k));
    total = total.map((row, i) => row.map((x, j) => x + term[i][j]));
  }
  for (let k = 0; k < halvings; k++) total = times(total, total);
  const m = n - 1;
  return [total.slice(0, m).map((row) => row.slice(0, m)), total.slice(0, m).map((row) => row[m])];
}

// Values and derivatives at a point: value[row] and column(k)[row], rows (rates, laws, u, z).
function pointAt(P, X, facts) {
  const rows = facts.lagged + facts.control + 2, inputs = X.length;
  const out = linearPoint(P, X, new Float64Array(rows * (inputs + 1)));
  return { value: out.subarray(0, rows), column: (k) => out.subarray(rows * (k + 1), rows * (k + 2)) };
}

// The equilibrium as the argument X of linearPoint, and the sizes of its components; null if the method finds none.
function equilibrium(P, facts) {
  const { lagged, control, past } = facts, n = lagged + control + 1;
  const begin = linearStart(P, new Float64Array(2 * n));
  const y = begin.slice(0, n), sizes = begin.slice(n), u = lagged;
  const full = (at) => [...at, ...new Array(past).fill(at[u]), 0];
  for (let trial = 0; trial < 60; trial++) {
    const X = Float64Array.from(full(y)), { value, column } = pointAt(P, X, facts);
    const residual = (v, k) => {
      const state = (j) => (k === undefined ? y[j] : Number(k === j));
      const rows = [];
      for (let j = 0; j < lagged; j++) rows.push(v[j]);
      rows.push(v[lagged + control] - state(u));
      for (let j = 0; j < control; j++) rows.push(v[lagged + j] - state(lagged + 1 + j));
      return rows;
    };
    const J = residual(value).map(() => []);
    for (let k = 0; k < n; k++) {
      let v = column(k);
      if (k === u) for (let lag = 0; lag < past; lag++) v = v.map((x, j) => x + column(n + lag)[j]);
      residual(v, k).forEach((x, j) => J[j].push(x * sizes[k]));
    }
    const step = solveReal(J, residual(value));
    let largest = 0;
    for (let k = 0; k < n; k++) {
      y[k] -= step[k] * sizes[k];
      largest = Math.max(largest, Math.abs(step[k]));
    }
    if (!Number.isFinite(largest)) return null;
    if (largest < 1e-9) return { X: Float64Array.from(full(y)), sizes };
  }
  return null;
}

// Matrices A, B, C of the map of one sample, scaled. State: (plant and lags, laws, u_{n-1}, u_{n-2}, ...); input: e; output: reading of z.
function sampleMap(P, facts, period, delay) {
  const point = equilibrium(P, facts);
  if (point === null) return null;
  const { lagged, control, past } = facts, { column } = pointAt(P, point.X, facts), first = lagged + control, n = first + past;
  const rates = (k) => Array.from(column(k).subarray(0, lagged));
  const A = rates(0).map((_, i) => rates(0).map((__, k) => column(k)[i])), B = rates(lagged);
  const part = (delay - Math.floor(delay)) * period;
  const [early, earlyIn] = held(A, B, part), [late, lateIn] = held(A, B, period - part);
  const old = times(late, earlyIn.map((x) => [x])).map((row) => row[0]), whole = times(late, early);
  const weight = (lag, i) => (lag === Math.ceil(delay) ? old[i] : 0) + (lag === Math.floor(delay) ? lateIn[i] : 0);
  // derivatives of all values of a point with respect to the plant and lags, the laws, the past voltages, and e
  const inputs = [];
  for (let k = 0; k < lagged; k++) inputs.push(column(k));
  for (let k = 0; k < control; k++) inputs.push(column(lagged + 1 + k));
  for (let k = 0; k <= past; k++) inputs.push(column(first + 1 + k));
  const M = [];
  for (let i = 0; i < lagged; i++) {
    M.push(inputs.map((c, k) => weight(0, i) * c[first] + (k < lagged ? whole[i][k] : 0)
      + (k >= first && k < n ? weight(k - first + 1, i) : 0)));
  }
  for (let i = 0; i < control; i++) M.push(inputs.map((c) => c[lagged + i]));
  M.push(inputs.map((c) => c[first]));
  for (let i = first; i < n - 1; i++) M.push(inputs.map((_, k) => (k === i ? 1 : 0)));
  const s = [...point.sizes.subarray(0, lagged), ...point.sizes.subarray(lagged + 1), ...new Array(past).fill(point.sizes[lagged])];
  // a state that e does not reach is no state of the linear loop
  let reached = M.map((row) => row[n] !== 0);
  for (let k = 0; k < n; k++) reached = M.map((row, i) => reached[i] || row.slice(0, n).some((x, j) => x !== 0 && reached[j]));
  const moves = (_, i) => reached[i], columns = (row) => row.slice(0, n).filter(moves);
  return {
    A: M.map((row, i) => columns(row.map((x, k) => (x * s[k]) / s[i]))).filter(moves),
    B: M.map((row, i) => row[n] / s[i]).filter(moves),
    C: inputs.slice(0, n).map((c, k) => c[first + 1] * s[k]).filter(moves),
  };
}

// |S| at a frequency in Hz: |1 + C (exp(2 pi j f T) I - A)^-1 B|.
function sizeOfS({ A, B, C }, f, period) {
  const n = B.length, angle = 2 * Math.PI * f * period, zr = Math.cos(angle), zi = Math.sin(angle);
  const re = A.map((row, i) => Float64Array.from([...row.map((x, k) => (i === k ? zr : 0) - x), B[i]]));
  const im = A.map((row, i) => Float64Array.from([...row.map((_, k) => (i === k ? zi : 0)), 0]));
  for (let k = 0; k < n; k++) {
    let p = k;
    for (let i = k + 1; i < n; i++) if (Math.hypot(re[i][k], im[i][k]) > Math.hypot(re[p][k], im[p][k])) p = i;
    [re[k], re[p]] = [re[p], re[k]];
    [im[k], im[p]] = [im[p], im[k]];
    const d = re[k][k] ** 2 + im[k][k] ** 2;
    for (let i = 0; i < n; i++) {
      if (i === k) continue;
      const fr = (re[i][k] * re[k][k] + im[i][k] * im[k][k]) / d, fi = (im[i][k] * re[k][k] - re[i][k] * im[k][k]) / d;
      if (fr === 0 && fi === 0) continue;
      for (let j = k; j <= n; j++) {
        re[i][j] -= fr * re[k][j] - fi * im[k][j];
        im[i][j] -= fr * im[k][j] + fi * re[k][j];
      }
    }
  }
  let sr = 1, si = 0;
  for (let k = 0; k < n; k++) {
    const d = re[k][k] ** 2 + im[k][k] ** 2;
    sr += (C[k] * (re[k][n] * re[k][k] + im[k][n] * im[k][k])) / d;
    si += (C[k] * (im[k][n] * re[k][k] - re[k][n] * im[k][k])) / d;
  }
  return Math.hypot(sr, si);
}

// Whether no power A^m grows up to m = 2^40, apart from the growth of modes on the unit circle, such as a slow integral.
function stable(A) {
  let M = A, logSize = 0;
  for (let k = 0; k < 40; k++) {
    M = times(M, M);
    const size = M.reduce((a, row) => row.reduce((t, x) => Math.max(t, Math.abs(x)), a), 0);
    if (size === 0) return true;
    if (!Number.isFinite(size)) return false;
    logSize = 2 * logSize + Math.log(size);
    M = M.map((row) => row.map((x) => x / size));
  }
  return logSize < 20;
}

// |S| at 300 frequencies (Hz), its peak and the ISO 14839-3 zone; null without an equilibrium.
function sensitivity(P, facts, period, delay) {
  const map = sampleMap(P, facts, period, delay), count = 300, f = [], size = [];
  if (map === null) return null;
  const at = (x) => sizeOfS(map, x, period);
  for (let k = 0; k < count; k++) {
    f.push(facts.low * (facts.high / facts.low) ** (k / (count - 1)));
    size.push(at(f[k]));
  }
  const top = size.indexOf(Math.max(...size)), golden = (Math.sqrt(5) - 1) / 2;
  let left = f[Math.max(top - 1, 0)], right = f[Math.min(top + 1, count - 1)];
  while (right > left * (1 + 1e-5)) {
    const a = right - golden * (right - left), b = left + golden * (right - left);
    if (at(a) > at(b)) right = b; else left = a;
  }
  const refined = (left + right) / 2, better = at(refined) > size[top], settles = stable(map.A);
  const peak = better ? at(refined) : size[top], zone = facts.zones.findIndex((limit) => peak < limit);
  return { f, size, peak, frequency: better ? refined : f[top], stable: settles, zone: settles && zone >= 0 ? "ABC"[zone] : "D" };
}
