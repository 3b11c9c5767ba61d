"use strict";
// The simulator's generator of normal numbers (ambjax/numerics/gaussian.py): Threefry-2x32, then Box and Muller.
const ROTATIONS = [[13, 15, 26, 6], [17, 29, 16, 24]];
const SINE = [6.283185307179586, -41.341702240399755, 81.60524927607362, -76.70585975282492, 42.058693925428685,
  -15.0946416761179, 3.8199280942271643, -0.7177337921413454, 0.10089695501646812];

// Write two random 32-bit words from the key (a, b) and the counter (x, y) into out.
function threefry(a, b, x, y, out) {
  const schedule = [a, b, a ^ b ^ 0x1BD11BDA];
  x = (x + a) | 0;
  y = (y + b) | 0;
  for (let group = 0; group < 5; group++) {
    const turns = ROTATIONS[group % 2];
    for (let k = 0; k < 4; k++) {
      x = (x + y) | 0;
      y = ((y << turns[k]) | (y >>> (32 - turns[k]))) ^ x;
    }
    x = (x + schedule[(group + 1) % 3]) | 0;
    y = (y + schedule[(group + 2) % 3] + group + 1) | 0;
  }
  out[0] = x >>> 0;
  out[1] = y >>> 0;
}

// The random key of a member: fold_in(key(seed), member) of jax.random.
function memberKey(seed, member) {
  const words = [0, 0];
  threefry(Math.floor(seed / 4294967296) | 0, seed | 0, 0, member | 0, words);
  return words;
}

// sin(2 pi y) for |y| <= 1/4.
function quarter(y) {
  const u = y * y;
  let total = 0;
  for (let k = SINE.length - 1; k >= 0; k--) total = total * u + SINE[k];
  return y * total;
}

// x minus the nearest whole number of turns.
function turned(x) { return x - Math.floor(x + 0.5); }
// cos(2 pi x) and sin(2 pi x).
function cosine(x) { return quarter(0.25 - Math.abs(turned(x))); }
function sine(x) {
  const y = turned(x);
  return quarter(Math.abs(y) > 0.25 ? (y < 0 ? -0.5 : 0.5) - y : y);
}

// sqrt(-2 ln((word + 1/2) / 2^32))
function radius(word) { return Math.sqrt(-2 * Math.log((word + 0.5) / 4294967296)); }

// Standard normal numbers of a member, three per sample [3 * samples], in a new array.
function normals(seed, member, samples) {
  const [a, b] = memberKey(seed, member), W = new Float64Array(3 * samples), first = [0, 0], second = [0, 0];
  for (let n = 0; n < samples; n++) {
    threefry(a, b, 1, n, first);
    threefry(a, b, 2, n, second);
    const turn = first[1] / 4294967296, r = radius(first[0]);
    W[3 * n] = r * cosine(turn);
    W[3 * n + 1] = r * sine(turn);
    W[3 * n + 2] = radius(second[0]) * cosine(second[1] / 4294967296);
  }
  return W;
}
