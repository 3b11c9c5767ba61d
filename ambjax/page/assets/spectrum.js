// Amplitudes of a signal over frequency (Hz), with a Hann window over a power of two of samples, from index `from` on.
function spectrum(signal, from, period) {
  const n = 2 ** Math.floor(Math.log2(signal.length - from)), re = new Float64Array(n), im = new Float64Array(n);
  let mean = 0;
  for (let k = 0; k < n; k++) mean += signal[from + k] / n;
  for (let k = 0; k < n; k++) re[k] = (signal[from + k] - mean) * (1 - Math.cos((2 * Math.PI * k) / n));
  transform(re, im);
  const f = [], amplitude = [];
  for (let k = 1; k < n / 2; k++) {
    f.push(k / (n * period));
    amplitude.push((2 / n) * Math.hypot(re[k], im[k]));
  }
  return { f, amplitude };
}

// Discrete Fourier transform in place, by the algorithm of Cooley and Tukey.
function transform(re, im) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let size = 2; size <= n; size *= 2) {
    for (let k = 0; k < size / 2; k++) {
      const c = Math.cos((-2 * Math.PI * k) / size), s = Math.sin((-2 * Math.PI * k) / size);
      for (let i = k; i < n; i += size) {
        const j = i + size / 2, x = re[j] * c - im[j] * s, y = re[j] * s + im[j] * c;
        re[j] = re[i] - x;
        im[j] = im[i] - y;
        re[i] += x;
        im[i] += y;
      }
    }
  }
}
