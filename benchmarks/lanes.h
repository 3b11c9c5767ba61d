/* What the C programs share: members in lanes, their arctangent and their noise.

   Vectors of BYTES bytes by GCC's vector extensions (with AVX-512: 64, 8 double or 16 float with -DREAL=float; without:
   32), two of them interleaved so that one chain's latency hides behind the other's work. Noise is Box-Muller on a hash
   of (seed, member, sample), drawn here and held over the sample: Gaussian, but not the numbers that jax.random draws.
*/

#ifndef LANES_H
#define LANES_H

#ifdef __AVX512F__
#include <immintrin.h>
#endif
#include <math.h>
#include <stdint.h>

#ifndef REAL
#define REAL double
#endif

/* Wider vectors than the processor's own are emulated by pairs of them, which is four times slower. */
#ifdef __AVX512F__
#define BYTES 64
#else
#define BYTES 32
#endif
#define LANES ((int)(BYTES / sizeof(REAL)))
#ifndef CHAINS
#define CHAINS 2
#endif
#define GROUP (CHAINS * LANES)
#define BLOCK 256 /* members per block: their state fits the first-level cache */
#define INLINE static inline __attribute__((always_inline))
#define EACH for (int j = 0; j < CHAINS; j++)

typedef REAL vec __attribute__((vector_size(BYTES)));
typedef struct { vec v[CHAINS]; } wide;

#ifdef SINGLE
typedef int32_t whole __attribute__((vector_size(BYTES)));
#else
typedef int64_t whole __attribute__((vector_size(BYTES)));
#endif

/* a < b ? yes : no. Written bitwise, GCC turns it into twice the work where there are mask registers. */
#if defined __AVX512F__ && defined SINGLE
#define LESS(a, b) _mm512_cmp_ps_mask((__m512)(a), (__m512)(b), _CMP_LT_OQ)
#define CHOOSE(mask, yes, no) ((vec)_mm512_mask_blend_ps(mask, (__m512)(no), (__m512)(yes)))
typedef __mmask16 mask;
#elif defined __AVX512F__
#define LESS(a, b) _mm512_cmp_pd_mask((__m512d)(a), (__m512d)(b), _CMP_LT_OQ)
#define CHOOSE(mask, yes, no) ((vec)_mm512_mask_blend_pd(mask, (__m512d)(no), (__m512d)(yes)))
typedef __mmask8 mask;
#else
#define LESS(a, b) ((a) < (b))
#define CHOOSE(mask, yes, no) ((vec)(((mask) & (whole)(yes)) | (~(mask) & (whole)(no))))
typedef whole mask;
#endif

INLINE vec all(REAL x) { return x - (vec){0}; }
INLINE vec signbit_of(vec x) { return (vec)((whole)x & (whole)(all((REAL)-0.0))); }
INLINE vec magnitude(vec x) { return (vec)((whole)x & ~(whole)(all((REAL)-0.0))); }
INLINE vec with_sign(vec size, vec x) { return (vec)((whole)size ^ (whole)signbit_of(x)); }

/* arctan in two parts around a division that the caller merges with others: reduce() gives num/den, the tangent of
   x's angle less 0, 45 or 90 degrees, so at most tan(pi/8); angle() takes the quotient. */
typedef struct { vec x, num, den, offset; } reduced;

/* arctan(y)/y in powers of y^2 for |y| <= tan(pi/8), fitted at Chebyshev nodes: 1e-15 and 1e-7 relative */
#ifdef SINGLE
#define TERMS 5
static const REAL ARCTAN[TERMS] = {0.999999982f, -0.333327969f, 0.199744048f, -0.138514784f, 0.0798496291f};
#else
#define TERMS 11
static const REAL ARCTAN[TERMS] = {
    1.0000000000000002, -0.3333333333332932, 0.19999999999166185, -0.14285714209486858,
    0.11111107410224096, -0.09090802758883151, 0.07690383903733038, -0.06644061411843283,
    0.05708771241668103, -0.044080212356633286, 0.0218800142570735,
};
#endif

INLINE reduced reduce(vec x) {
    const REAL low = (REAL)0.41421356237309503, high = (REAL)2.414213562373095, quarter = (REAL)0.7853981633974483;
    vec size = magnitude(x);
    mask middle = LESS(all(low), size), large = LESS(all(high), size);
    vec num = CHOOSE(large, all(-1), CHOOSE(middle, size - 1, size));
    vec den = CHOOSE(large, size, CHOOSE(middle, size + 1, all(1)));
    vec offset = CHOOSE(large, all(2 * quarter), CHOOSE(middle, all(quarter), all(0)));
    return (reduced){x, num, den, offset};
}

INLINE vec angle(reduced a, vec y) {
    const REAL *A = ARCTAN;
    vec u = y * y, v = u * u;
#ifdef SINGLE
    vec sum = (A[0] + A[1] * u) + v * ((A[2] + A[3] * u) + v * A[4]);
#else
    vec w = v * v, low = (A[0] + A[1] * u) + v * (A[2] + A[3] * u), high = (A[4] + A[5] * u) + v * (A[6] + A[7] * u);
    vec sum = low + w * (high + w * ((A[8] + A[9] * u) + v * A[10]));
#endif
    return with_sign(a.offset + y * sum, a.x);
}

INLINE wide load(const REAL *from) {
    wide out;
    EACH out.v[j] = *(const vec *)(from + j * LANES);
    return out;
}

INLINE void store(REAL *to, wide x) { EACH *(vec *)(to + j * LANES) = x.v[j]; }

INLINE wide plus(wide x, REAL h, wide k) {
    wide out;
    EACH out.v[j] = x.v[j] + h * k.v[j];
    return out;
}

INLINE uint64_t hash(uint64_t x) {
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

/* log of u in (0, 1): exponent and mantissa apart, the mantissa by its series in (m - 1)/(m + 1). */
INLINE double logarithm(double u) {
    union { double x; int64_t n; } bits = {u};
    double exponent = (double)((bits.n >> 52) - 1022);
    bits.n = (bits.n & 0x000fffffffffffff) | 0x3fe0000000000000;
    double f = (bits.x - 1) / (bits.x + 1), s = f * f, sum = 1.0 / 25;
    for (int n = 23; n >= 1; n -= 2) sum = sum * s + 1.0 / n;
    return exponent * 0.6931471805599453 + 2 * f * sum;
}

/* Two normal numbers from one hash, 32 bits to each uniform: Box-Muller. The angle is four times one in [-pi/4, pi/4]. */
INLINE void normals(uint64_t counter, double *x, double *y) {
    uint64_t bits = hash(counter);
    double u = ((double)(int64_t)(bits >> 32) + 0.5) * 0x1p-32;
    double q = ((double)(int64_t)(bits & 0xffffffffu) - 0x1p31) * (0x1p-32 * 1.5707963267948966);
    double s = q * q;
    double sine = q * (1 + s * (-1.0 / 6 + s * (1.0 / 120 + s * (-1.0 / 5040 + s * (1.0 / 362880)))));
    double twice = 2 * sine * (1 + s * (-0.5 + s * (1.0 / 24 + s * (-1.0 / 720 + s * (1.0 / 40320)))));
    double cosine = 1 - 2 * sine * sine, radius = sqrt(-2 * logarithm(u));
    *x = radius * 2 * twice * cosine;
    *y = radius * (1 - 2 * twice * twice);
}

/* Measurement errors of members `first` and on for one sample. Plain loops: the compiler makes vectors of them. */
INLINE void draw(int64_t seed, int64_t first, long sample, long padded, const double std[3], REAL w[3][BLOCK]) {
    for (long n = 0; n < padded; n++) {
        uint64_t base = hash((uint64_t)seed + 0x9e3779b97f4a7c15u * (uint64_t)(first + n + 1));
        double a, b, c, d;
        normals(base + 2 * (uint64_t)sample, &a, &b);
        normals(base + 2 * (uint64_t)sample + 1, &c, &d);
        w[0][n] = (REAL)(std[0] * a);
        w[1][n] = (REAL)(std[1] * b);
        w[2][n] = (REAL)(std[2] * c);
    }
}

#endif
