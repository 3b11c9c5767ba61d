/* The machine's limit: the benchmarks' closed loop in C with SIMD, as fast as we know how to write it.

   Vectors of 64 bytes (8 double or 16 float; -DREAL=float) by GCC's vector extensions, two of them
   interleaved so that one chain's latency hides behind the other's work. The state stays in registers over a
   sample; there are three divisions per evaluation, all else being merged into them; the arctangent is a rational
   function of its own. A rotor that touches down is frozen. The guards that no levitated rotor meets (gap and
   gradient floors, an infinite supply's limit) are left out.

   Noise is Box-Muller on a hash of (seed, member, sample), drawn here and held over the sample: Gaussian, but
   not the numbers that jax.random draws. */

#ifdef __AVX512F__
#include <immintrin.h>
#endif
#include <math.h>
#include <stdint.h>

#ifndef REAL
#define REAL double
#endif

#define LANES ((int)(64 / sizeof(REAL)))
#define CHAINS 2
#define GROUP (CHAINS * LANES)
#define BLOCK 256 /* members per block: their state fits the first-level cache */
#define MOST_SUBSTEPS 64
#define INLINE static inline __attribute__((always_inline))
#define EACH for (int j = 0; j < CHAINS; j++)

typedef REAL vec __attribute__((vector_size(64)));
typedef struct { vec v[CHAINS]; } wide;

/* What limit.py fills in; the same order there. */
typedef struct {
    double m, k_z, s_0, i_0, R, g, kappa, a, touchdown;
    double c, k, p_sigma, gamma, p_v, k_i, p_e;
    double amplitude, frequency, force;
    double std_z, std_z_dot, std_i;
    double sample_period;
    int64_t substeps, samples, pulse_start, pulse_stop;
    int64_t seed, first_member;
} problem;

/* The constants of the loop in the precision of the run. */
typedef struct {
    REAL s_0, i_0, stiff, c, demand_z, demand_z_dot, demand_sign, p_sigma, p_sigma_c, p_v, p_e, rate, minus_k_i;
    REAL half_kappa, two_per_kappa, R, a, touchdown;
} constants;

/* The reference at one instant: p_sigma (r_dot + c r) and (r_ddot + g + c r_dot)/a. */
typedef struct { REAL sigma, feed; } stage;

typedef struct { wide z, z_dot, i, i_ref; } state;
typedef struct { wide z, z_dot, i; } held;

#ifdef SINGLE
typedef int32_t whole __attribute__((vector_size(64)));
#else
typedef int64_t whole __attribute__((vector_size(64)));
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

/* Rates: Eqs. (1), (2), (5), (6) and (11), what is measured being off by w (0 unless `noisy`).
   One line is one operation on every chain, so that they are interleaved instruction by instruction. */
INLINE state rates(const constants *k, stage at, REAL q, const state s, const held *w, const int noisy) {
    vec z[CHAINS], z_dot[CHAINS], i[CHAINS], up_m[CHAINS], low_m[CHAINS], up[CHAINS], low[CHAINS];
    vec plus[CHAINS], minus[CHAINS], slope[CHAINS], gaps[CHAINS], product[CHAINS], inverse[CHAINS], per[CHAINS];
    vec per_up[CHAINS], per_low[CHAINS], per_up_m[CHAINS], per_low_m[CHAINS], rate[CHAINS];
    vec force[CHAINS], rest[CHAINS], gain[CHAINS], all_gaps[CHAINS];
    reduced a[CHAINS], b[CHAINS], c[CHAINS];
    state out;
    EACH z[j] = noisy ? s.z.v[j] + w->z.v[j] : s.z.v[j];
    EACH z_dot[j] = noisy ? s.z_dot.v[j] + w->z_dot.v[j] : s.z_dot.v[j];
    EACH i[j] = noisy ? s.i.v[j] + w->i.v[j] : s.i.v[j];
    EACH a[j] = reduce(k->p_sigma_c * z[j] + (k->p_sigma * z_dot[j] - at.sigma));
    EACH rate[j] = a[j].num / a[j].den;

    /* dv/di = 2 slope / gaps^2, so that one division serves gaps, slope and the current law's sign. */
    EACH b[j] = reduce(k->p_e * (i[j] - s.i_ref.v[j]));
    EACH up_m[j] = k->s_0 - z[j], low_m[j] = k->s_0 + z[j];
    EACH plus[j] = k->i_0 + s.i_ref.v[j], minus[j] = k->i_0 - s.i_ref.v[j];
    EACH gaps[j] = up_m[j] * low_m[j];
    EACH slope[j] = plus[j] * low_m[j] * low_m[j] + minus[j] * up_m[j] * up_m[j];
    EACH up[j] = noisy ? k->s_0 - s.z.v[j] : up_m[j], low[j] = noisy ? k->s_0 + s.z.v[j] : low_m[j];
    EACH all_gaps[j] = noisy ? gaps[j] * (up[j] * low[j]) : gaps[j];
    EACH product[j] = all_gaps[j] * slope[j];
    EACH inverse[j] = 1 / (product[j] * b[j].den);
    EACH b[j].num *= inverse[j] * product[j];
    EACH inverse[j] *= b[j].den;
    EACH per[j] = inverse[j] * slope[j];
    if (noisy) {
        EACH per_up[j] = per[j] * gaps[j] * low[j], per_low[j] = per[j] * gaps[j] * up[j];
        EACH per[j] *= up[j] * low[j];
    }
    EACH per_up_m[j] = per[j] * low_m[j], per_low_m[j] = per[j] * up_m[j];
    EACH per_up[j] = noisy ? per_up[j] : per_up_m[j], per_low[j] = noisy ? per_low[j] : per_low_m[j];
    EACH slope[j] = (k->rate * inverse[j] * all_gaps[j]) * (gaps[j] * gaps[j]);

    EACH plus[j] *= per_up_m[j], minus[j] *= per_low_m[j];
    EACH rest[j] = (k->demand_z * z[j] + (at.feed + k->demand_z_dot * z_dot[j])) - plus[j] * plus[j] + minus[j] * minus[j];
    EACH c[j] = reduce(k->p_v * rest[j] + k->demand_sign * angle(a[j], rate[j]));
    EACH rate[j] = slope[j] * angle(c[j], c[j].num / c[j].den);

    /* i_dot = gain i_ref_dot + rest, u = half_kappa/low_m i_ref_dot + rest of its own */
    EACH rest[j] = k->minus_k_i * angle(b[j], b[j].num) - 2 * z_dot[j] * per_low_m[j] * i[j];
    EACH rest[j] = k->half_kappa * per_low_m[j] * rest[j] + k->R * (i[j] - s.i.v[j]);
    EACH rest[j] = k->two_per_kappa * low[j] * rest[j] + 2 * s.z_dot.v[j] * per_low[j] * s.i.v[j];
    EACH gain[j] = low[j] * per_low_m[j];
    EACH plus[j] = (k->i_0 + s.i.v[j]) * per_up[j], minus[j] = (k->i_0 - s.i.v[j]) * per_low[j];
    EACH force[j] = (q - k->stiff * s.z.v[j]) + k->a * (plus[j] * plus[j] - minus[j] * minus[j]);
    EACH out.z.v[j] = s.z_dot.v[j], out.z_dot.v[j] = force[j];
    EACH out.i.v[j] = gain[j] * rate[j] + rest[j], out.i_ref.v[j] = rate[j];
    return out;
}

INLINE wide plus(wide x, REAL h, wide k) {
    wide out;
    EACH out.v[j] = x.v[j] + h * k.v[j];
    return out;
}

INLINE state moved(state x, REAL h, state k) {
    return (state){plus(x.z, h, k.z), plus(x.z_dot, h, k.z_dot), plus(x.i, h, k.i), plus(x.i_ref, h, k.i_ref)};
}

/* One RK4 step; `at` holds the reference at its start, middle and end. */
INLINE state step(const constants *k, const stage *at, REAL q, REAL h, state x, const held *w, const int noisy) {
    state k_1 = rates(k, at[0], q, x, w, noisy);
    state sum = moved(x, h / 6, k_1);
    state k_2 = rates(k, at[1], q, moved(x, h / 2, k_1), w, noisy);
    sum = moved(sum, h / 3, k_2);
    state k_3 = rates(k, at[1], q, moved(x, h / 2, k_2), w, noisy);
    sum = moved(sum, h / 3, k_3);
    state k_4 = rates(k, at[2], q, moved(x, h, k_3), w, noisy);
    return moved(sum, h / 6, k_4);
}

/* Where a rotor is or was outside the gap (or not a number), the old state, the rotor at rest against the stop. */
INLINE state frozen(const constants *k, state old, state new) {
    EACH {
        vec z = old.z.v[j], limit = all(k->touchdown);
        mask is = LESS(magnitude(new.z.v[j]), limit), kept = LESS(magnitude(z), limit) & is;
        new.z.v[j] = CHOOSE(kept, new.z.v[j], with_sign(limit, z));
        new.z_dot.v[j] = CHOOSE(kept, new.z_dot.v[j], all(0));
        new.i.v[j] = CHOOSE(kept, new.i.v[j], old.i.v[j]);
        new.i_ref.v[j] = CHOOSE(kept, new.i_ref.v[j], old.i_ref.v[j]);
    }
    return new;
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

/* Measurement errors of a block for one sample. Plain loops: the compiler makes vectors of them. */
static void draw(const problem *p, long first, long sample, long padded, REAL w[3][BLOCK]) {
    for (long n = 0; n < padded; n++) {
        uint64_t base = hash((uint64_t)p->seed + 0x9e3779b97f4a7c15u * (uint64_t)(p->first_member + first + n + 1));
        double a, b, c, d;
        normals(base + 2 * (uint64_t)sample, &a, &b);
        normals(base + 2 * (uint64_t)sample + 1, &c, &d);
        w[0][n] = (REAL)(p->std_z * a);
        w[1][n] = (REAL)(p->std_z_dot * b);
        w[2][n] = (REAL)(p->std_i * c);
    }
}

/* The reference at the start, middle and end of each substep of a sample. */
static void references(const problem *p, long sample, stage *at, REAL *r) {
    double omega = 2 * M_PI * p->frequency, h = p->sample_period / (double)p->substeps;
    for (long n = 0; n <= 2 * p->substeps; n++) {
        double t = (double)sample * p->sample_period + 0.5 * h * (double)n;
        double sine = p->amplitude * sin(omega * t), cosine = p->amplitude * cos(omega * t) * omega;
        at[n].sigma = (REAL)(p->p_sigma * (cosine + p->c * sine));
        at[n].feed = (REAL)((-omega * omega * sine + p->g + p->c * cosine) / p->a);
        if (n == 0) *r = (REAL)sine;
    }
}

static constants constants_of(const problem *p) {
    const double per_half_pi = 2 / M_PI;
    return (constants){
        .s_0 = (REAL)p->s_0, .i_0 = (REAL)p->i_0, .stiff = (REAL)(-2 * p->k_z / p->m), .c = (REAL)p->c,
        .demand_z = (REAL)(-2 * p->k_z / p->m / p->a), .demand_z_dot = (REAL)(-p->c / p->a),
        .demand_sign = (REAL)(-p->k * per_half_pi / p->a * p->p_v), .p_sigma = (REAL)p->p_sigma,
        .p_sigma_c = (REAL)(p->p_sigma * p->c),
        .p_v = (REAL)p->p_v, .p_e = (REAL)p->p_e, .rate = (REAL)(p->gamma * per_half_pi / 2),
        .minus_k_i = (REAL)(-p->k_i * per_half_pi), .half_kappa = (REAL)(p->kappa / 2),
        .two_per_kappa = (REAL)(2 / p->kappa), .R = (REAL)p->R, .a = (REAL)p->a, .touchdown = (REAL)p->touchdown,
    };
}

INLINE wide load(const REAL *from) {
    wide out;
    EACH out.v[j] = *(const vec *)(from + j * LANES);
    return out;
}

INLINE void store(REAL *to, wide x) { EACH *(vec *)(to + j * LANES) = x.v[j]; }

typedef struct { REAL z[BLOCK], z_dot[BLOCK], i[BLOCK], i_ref[BLOCK], peak[BLOCK]; } memory;

/* One sample of one block. */
INLINE void advance(
    const problem *p, const constants *k, long sample, long count, memory *m, REAL noise[3][BLOCK], const int noisy
) {
    stage at[2 * MOST_SUBSTEPS + 1];
    REAL r, h = (REAL)(p->sample_period / (double)p->substeps);
    references(p, sample, at, &r);
    REAL force = sample >= p->pulse_start && sample < p->pulse_stop ? (REAL)p->force : 0;
    REAL q = k->a * force - (REAL)p->g;
    for (long n = 0; n < count; n += GROUP) {
        state x = {load(m->z + n), load(m->z_dot + n), load(m->i + n), load(m->i_ref + n)};
        held w = {load(noise[0] + n), load(noise[1] + n), load(noise[2] + n)};
        wide peak = load(m->peak + n);
        EACH {
            vec error = magnitude(x.z.v[j] - r);
            peak.v[j] = CHOOSE(LESS(peak.v[j], error), error, peak.v[j]);
        }
        store(m->peak + n, peak);
        for (long s = 0; s < p->substeps; s++) x = frozen(k, x, step(k, at + 2 * s, q, h, x, &w, noisy));
        store(m->z + n, x.z), store(m->z_dot + n, x.z_dot), store(m->i + n, x.i), store(m->i_ref + n, x.i_ref);
    }
}

/* Roll out `members` members from z at rest; `peak` gets the largest |z - r| at a sample's start, z the last z.
   `members` is any number; the last group is padded. Returns 0, or 1 where there are too many substeps. */
int run(const problem *p, long members, REAL *z, REAL *peak) {
    constants k = constants_of(p);
    memory m __attribute__((aligned(64)));
    REAL noise[3][BLOCK] __attribute__((aligned(64))) = {{0}};
    int noisy = p->std_z != 0 || p->std_z_dot != 0 || p->std_i != 0;
    if (p->substeps > MOST_SUBSTEPS) return 1;
    for (long first = 0; first < members; first += BLOCK) {
        long count = members - first < BLOCK ? members - first : BLOCK, padded = (count + GROUP - 1) / GROUP * GROUP;
        for (long n = 0; n < BLOCK; n++) {
            m.z[n] = n < count ? z[first + n] : 0;
            m.z_dot[n] = m.i[n] = m.i_ref[n] = m.peak[n] = 0;
        }
        for (long sample = 0; sample < p->samples; sample++) {
            if (noisy) {
                draw(p, first, sample, padded, noise);
                advance(p, &k, sample, count, &m, noise, 1);
            } else {
                advance(p, &k, sample, count, &m, noise, 0);
            }
        }
        for (long n = 0; n < count; n++) z[first + n] = m.z[n], peak[first + n] = m.peak[n];
    }
    return 0;
}
