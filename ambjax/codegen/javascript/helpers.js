const max = (a, b) => a > b || a !== a ? a : b;
const min = (a, b) => a < b || a !== a ? a : b;
const pow = (a, b) => a === 1 || (a === -1 && (b === Infinity || b === -Infinity)) ? 1 : Math.pow(a, b);
const roundAway = x => {
  const a = Math.abs(x), f = Math.floor(a), r = a - f >= 0.5 ? f + 1 : f;
  return x > 0 ? r : x < 0 ? -r : x;
};
const roundEven = x => {
  const big = 4503599627370496, a = Math.abs(x);
  return x === 0 || !(a < big) ? x : x > 0 ? a + big - big : -(a + big - big);
};
const erf = x => {
  const a = Math.abs(x);
  if (!(a < 3)) return x !== x ? x : Math.sign(x) * (1 - erfc(a));
  let term = x, sum = x;
  for (let n = 1; n < 200; n++) { term *= 2 * x * x / (2 * n + 1); sum += term; }
  return 2 / Math.sqrt(Math.PI) * Math.exp(-x * x) * sum;
};
const erfc = x => {
  if (x !== x) return x;
  if (x < 1) return 1 - erf(x);
  if (x > 27) return 0;
  let f = 0;
  for (let n = 300; n > 0; n--) f = n / 2 / (x + f);
  return Math.exp(-x * x) / Math.sqrt(Math.PI) / (x + f);
};
