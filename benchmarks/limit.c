/* The machine's limit: the benchmarks' closed loop in C with SIMD, as fast as we know how to write it.

   Vectors by GCC's vector extensions, interleaved in chains as lanes.h says. The state stays in registers over a
   sample; there are three divisions per evaluation, all else being merged into them; the arctangent is a rational
   function of its own. A rotor that touches down is frozen. The guards that no levitated rotor meets (gap and
   gradient floors, an infinite supply's limit) are left out.

   Noise is Box-Muller on a hash of (seed, member, sample), drawn here and held over the sample: Gaussian, but
   not the numbers that jax.random draws. */

#include "lanes.h"

#define MOST_SUBSTEPS 64

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
    const double std[3] = {p->std_z, p->std_z_dot, p->std_i};
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
                draw(p->seed, p->first_member + first, sample, padded, std, noise);
                advance(p, &k, sample, count, &m, noise, 1);
            } else {
                advance(p, &k, sample, count, &m, noise, 0);
            }
        }
        for (long n = 0; n < count; n++) z[first + n] = m.z[n], peak[first + n] = m.peak[n];
    }
    return 0;
}
