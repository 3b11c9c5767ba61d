/* The machine's limit on a processor: the paper's cascade sampled, with one sample of delay and prediction, in C with
   SIMD, as fast as we know how to write it.

   A sample at a time, all in registers: sensors are read, the laws step on the estimate carried over the delay by one
   RK4 step of the model, and the plant alone moves under the voltage of the sample before. v(z, i) is written as a
   product, v = 4 (i_0 z + s_0 i)(i_0 s_0 + i z)/(s_0^2 - z^2)^2, so that there is one division per evaluation. A rotor
   that touches down is frozen. The guards that no levitated rotor meets (gap floor, unreachable force) are left out. */

#include "lanes.h"

#define MOST_SUBSTEPS 16
#define HALLEY 3

/* What sampled.py fills in; the same order there. */
typedef struct {
    double m, k_z, s_0, i_0, R, g, kappa, a, touchdown;
    double c, k, p_sigma, gamma, p_v, k_i, p_e;
    double amplitude, frequency, force;
    double std_z, std_z_dot, std_i;
    double sample_period, u_max;
    int64_t substeps, samples, pulse_start, pulse_stop;
    int64_t seed, first_member;
} problem;

/* The constants of the loop in the precision of the run. Forces are per 4 a. */
typedef struct {
    REAL s_0, i_0, s_0_2, i_0_s_0, stiff, a_4, two_per_kappa, half_kappa, R, g, touchdown, u_max, T, per_T;
    REAL c, demand_z, per_a, k, gamma, k_i, p_sigma, p_v, p_e;
} constants;

typedef struct { REAL r, r_dot, r_ddot; } reference;
typedef struct { wide z, z_dot, i; } state;

/* 1/x: refined from 14 bits where there is an instruction for that, which leaves the divider to others. */
INLINE vec inverse_of(vec x) {
#if defined __AVX512F__ && !defined SINGLE
    vec y = (vec)_mm512_rcp14_pd((__m512d)x), e = 1 - x * y;
    y += y * e;
    e = 1 - x * y;
    return y + y * e;
#else
    return 1 / x;
#endif
}

INLINE vec root_of(vec x) {
#if defined __AVX512F__ && !defined SINGLE
    return (vec)_mm512_sqrt_pd((__m512d)x);
#elif defined __AVX512F__
    return (vec)_mm512_sqrt_ps((__m512)x);
#else
    for (int n = 0; n < LANES; n++) x[n] = (REAL)sqrt((double)x[n]);
    return x;
#endif
}

INLINE vec limited(vec x, vec most) {
    x = CHOOSE(LESS(most, x), most, x);
    return CHOOSE(LESS(x, -most), -most, x);
}

/* Eqs. (1) and (2) under the voltage u, q the acceleration from outside less g. */
INLINE state rates(const constants *k, REAL q, const state s, const wide *u) {
    vec inverse[CHAINS], above[CHAINS], below[CHAINS], low[CHAINS];
    state out;
    EACH inverse[j] = inverse_of(k->s_0_2 - s.z.v[j] * s.z.v[j]);
    EACH above[j] = (k->i_0 * s.z.v[j] + k->s_0 * s.i.v[j]) * inverse[j];
    EACH below[j] = (k->i_0_s_0 + s.i.v[j] * s.z.v[j]) * inverse[j];
    EACH low[j] = k->s_0 + s.z.v[j];
    EACH out.z.v[j] = s.z_dot.v[j];
    EACH out.z_dot.v[j] = (q + k->stiff * s.z.v[j]) + k->a_4 * above[j] * below[j];
    EACH above[j] = s.z_dot.v[j] * ((k->s_0 - s.z.v[j]) * inverse[j]) * s.i.v[j];
    EACH out.i.v[j] = k->two_per_kappa * low[j] * (u->v[j] - k->R * s.i.v[j]) + 2 * above[j];
    return out;
}

INLINE state moved(state x, REAL h, state k) {
    return (state){plus(x.z, h, k.z), plus(x.z_dot, h, k.z_dot), plus(x.i, h, k.i)};
}

/* One RK4 step. */
INLINE state step(const constants *k, REAL q, REAL h, state x, const wide *u) {
    state k_1 = rates(k, q, x, u);
    state sum = moved(x, h / 6, k_1);
    state k_2 = rates(k, q, moved(x, h / 2, k_1), u);
    sum = moved(sum, h / 3, k_2);
    state k_3 = rates(k, q, moved(x, h / 2, k_2), u);
    sum = moved(sum, h / 3, k_3);
    state k_4 = rates(k, q, moved(x, h, k_3), u);
    return moved(sum, h / 6, k_4);
}

INLINE vec arctan_of(vec x) {
    reduced a = reduce(x);
    return angle(a, a.num * inverse_of(a.den));
}

/* The y with y + h arctan(y) = x: Halley's method from the root for a sign with the same slope and tail. */
INLINE wide relaxed(wide x, REAL h) {
    const REAL eps = (REAL)0.6366197723675814, reach = h / eps;
    vec size[CHAINS], y[CHAINS], b[CHAINS], root[CHAINS], flat[CHAINS], steep[CHAINS], error[CHAINS];
    mask high[CHAINS];
    wide out;
    EACH size[j] = magnitude(x.v[j]);
    EACH b[j] = eps + reach - size[j];
    EACH root[j] = root_of(b[j] * b[j] + 4 * eps * size[j]);
    EACH high[j] = LESS(all(0), b[j]);
    EACH y[j] = CHOOSE(high[j], 2 * eps * size[j] * inverse_of(magnitude(b[j]) + root[j]), (root[j] - b[j]) / 2);
    for (int n = 0; n < HALLEY; n++) {
        EACH flat[j] = 1 + y[j] * y[j];
        EACH error[j] = y[j] + h * arctan_of(y[j]) - size[j];
        EACH steep[j] = flat[j] + h;
        EACH y[j] -= error[j] * flat[j] * steep[j] * inverse_of(steep[j] * steep[j] + y[j] * h * error[j]);
    }
    EACH out.v[j] = with_sign(y[j], x.v[j]);
    return out;
}

/* The w+ with w+ + h sgn(w+) = w. */
INLINE wide relax(wide w, REAL h, REAL p, int hard) {
    wide out;
    if (hard) {
        EACH out.v[j] = w.v[j] - limited(w.v[j], all(h));
        return out;
    }
    EACH w.v[j] *= p;
    out = relaxed(w, (REAL)M_2_PI * p * h);
    EACH out.v[j] *= 1 / p;
    return out;
}

/* sgn of that. */
INLINE wide share(wide w, REAL h, REAL p, int hard) {
    wide out;
    if (hard) {
        EACH out.v[j] = limited(w.v[j] * (1 / h), all(1));
        return out;
    }
    EACH w.v[j] *= p;
    out = relaxed(w, (REAL)M_2_PI * p * h);
    EACH out.v[j] = (REAL)M_2_PI * arctan_of(out.v[j]);
    return out;
}

/* The laws' step on the estimate x: the voltage, and i_ref at the next sample. Eqs. (5), (6) and (11). */
INLINE wide decided(const constants *k, reference at, const state x, wide *i_ref, int hard) {
    vec z_2[CHAINS], e_z_dot[CHAINS], product[CHAINS], inverse[CHAINS], difference[CHAINS], root[CHAINS];
    vec above[CHAINS], below[CHAINS], rate[CHAINS], per_low[CHAINS];
    wide sigma, w, e, u, target;
    EACH e_z_dot[j] = x.z_dot.v[j] - at.r_dot;
    EACH sigma.v[j] = e_z_dot[j] + k->c * (x.z.v[j] - at.r);
    sigma = share(sigma, k->T * k->k, k->p_sigma, hard);
    EACH target.v[j] = k->demand_z * x.z.v[j] - k->c * e_z_dot[j] + (at.r_ddot + k->g) - k->k * sigma.v[j];
    EACH target.v[j] *= k->per_a;

    EACH z_2[j] = x.z.v[j] * x.z.v[j];
    EACH product[j] = k->s_0_2 - z_2[j];
    EACH inverse[j] = inverse_of(product[j]);
    EACH above[j] = (k->i_0 * x.z.v[j] + k->s_0 * i_ref->v[j]) * inverse[j];
    EACH below[j] = (k->i_0_s_0 + i_ref->v[j] * x.z.v[j]) * inverse[j];
    EACH w.v[j] = target.v[j] - 4 * above[j] * below[j];
    w = relax(w, k->T * k->gamma, k->p_v, hard);
    EACH target.v[j] -= w.v[j];

    /* the root of Eq. (3), times (s_0^2 - z^2)^2 */
    EACH difference[j] = 4 * k->s_0 * x.z.v[j];
    EACH root[j] = product[j] * root_of(4 * k->i_0 * k->i_0 + difference[j] * target.v[j]);
    EACH above[j] = target.v[j] * product[j] * product[j] - k->i_0 * k->i_0 * difference[j];
    EACH target.v[j] = above[j] * inverse_of(2 * k->i_0 * (k->s_0_2 + z_2[j]) + root[j]);

    EACH e.v[j] = x.i.v[j] - i_ref->v[j];
    e = share(e, k->T * k->k_i, k->p_e, hard);
    EACH rate[j] = (target.v[j] - i_ref->v[j]) * k->per_T - k->k_i * e.v[j];
    EACH per_low[j] = (k->s_0 - x.z.v[j]) * inverse[j];
    EACH rate[j] -= 2 * x.z_dot.v[j] * per_low[j] * x.i.v[j];
    EACH u.v[j] = limited(k->half_kappa * per_low[j] * rate[j] + k->R * x.i.v[j], all(k->u_max));
    *i_ref = target;
    return u;
}

/* Where a rotor is or was outside the gap (or not a number), the old state, the rotor at rest against the stop. */
INLINE state frozen(const constants *k, state old, state new) {
    EACH {
        vec z = old.z.v[j], limit = all(k->touchdown);
        mask is = LESS(magnitude(new.z.v[j]), limit), kept = LESS(magnitude(z), limit) & is;
        new.z.v[j] = CHOOSE(kept, new.z.v[j], with_sign(limit, z));
        new.z_dot.v[j] = CHOOSE(kept, new.z_dot.v[j], all(0));
        new.i.v[j] = CHOOSE(kept, new.i.v[j], old.i.v[j]);
    }
    return new;
}

static reference reference_at(const problem *p, double t) {
    double omega = 2 * M_PI * p->frequency, sine = p->amplitude * sin(omega * t);
    double cosine = p->amplitude * cos(omega * t) * omega;
    return (reference){(REAL)sine, (REAL)cosine, (REAL)(-omega * omega * sine)};
}

static constants constants_of(const problem *p) {
    return (constants){
        .s_0 = (REAL)p->s_0, .i_0 = (REAL)p->i_0, .s_0_2 = (REAL)(p->s_0 * p->s_0), .i_0_s_0 = (REAL)(p->i_0 * p->s_0),
        .stiff = (REAL)(2 * p->k_z / p->m), .a_4 = (REAL)(4 * p->a), .two_per_kappa = (REAL)(2 / p->kappa),
        .half_kappa = (REAL)(p->kappa / 2), .R = (REAL)p->R, .g = (REAL)p->g, .touchdown = (REAL)p->touchdown,
        .u_max = (REAL)p->u_max, .T = (REAL)p->sample_period, .per_T = (REAL)(1 / p->sample_period),
        .c = (REAL)p->c, .demand_z = (REAL)(-2 * p->k_z / p->m), .per_a = (REAL)(1 / p->a), .k = (REAL)p->k,
        .gamma = (REAL)p->gamma, .k_i = (REAL)p->k_i,
        .p_sigma = (REAL)p->p_sigma, .p_v = (REAL)p->p_v, .p_e = (REAL)p->p_e,
    };
}

typedef struct { REAL z[BLOCK], z_dot[BLOCK], i[BLOCK], i_ref[BLOCK], u[BLOCK], peak[BLOCK]; } memory;

/* One sample of one block. The voltage that acts is that of the sample before. */
INLINE void advance(const problem *p, const constants *k, long sample, long count, memory *m, REAL noise[3][BLOCK], int hard) {
    REAL r[MOST_SUBSTEPS], h = (REAL)(p->sample_period / (double)p->substeps);
    reference at = reference_at(p, (double)(sample + 1) * p->sample_period);
    for (long s = 0; s < p->substeps; s++) {
        r[s] = reference_at(p, ((double)sample + (double)s / (double)p->substeps) * p->sample_period).r;
    }
    REAL force = sample >= p->pulse_start && sample < p->pulse_stop ? (REAL)(p->a * p->force) : 0;
    for (long n = 0; n < count; n += GROUP) {
        state x = {load(m->z + n), load(m->z_dot + n), load(m->i + n)}, seen;
        wide u = load(m->u + n), i_ref = load(m->i_ref + n), peak = load(m->peak + n);
        EACH seen.z.v[j] = x.z.v[j] + *(vec *)(noise[0] + n + j * LANES);
        EACH seen.z_dot.v[j] = x.z_dot.v[j] + *(vec *)(noise[1] + n + j * LANES);
        EACH seen.i.v[j] = x.i.v[j] + *(vec *)(noise[2] + n + j * LANES);
        seen = step(k, -k->g, k->T, seen, &u);
        store(m->u + n, decided(k, at, seen, &i_ref, hard));
        store(m->i_ref + n, i_ref);
        for (long s = 0; s < p->substeps; s++) {
            EACH {
                vec error = magnitude(x.z.v[j] - r[s]);
                peak.v[j] = CHOOSE(LESS(peak.v[j], error), error, peak.v[j]);
            }
            x = frozen(k, x, step(k, force - k->g, h, x, &u));
        }
        store(m->peak + n, peak);
        store(m->z + n, x.z), store(m->z_dot + n, x.z_dot), store(m->i + n, x.i);
    }
}

/* Roll out `members` members from z at rest; `peak` gets the largest |z - r| at a substep's start, z the last z.
   Measurement errors are `given` [samples][3][members], or drawn where that is null. `members` is any number; the last
   group is padded. Returns 0, or 1 where there are too many substeps. */
int run(const problem *p, long members, REAL *z, REAL *peak, const double *given) {
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
            m.z_dot[n] = m.i[n] = m.i_ref[n] = m.u[n] = m.peak[n] = 0;
        }
        for (long sample = 0; sample < p->samples; sample++) {
            if (given) {
                for (long c = 0; c < 3; c++)
                    for (long n = 0; n < count; n++)
                        noise[c][n] = (REAL)given[(sample * 3 + c) * members + first + n];
            } else if (noisy) {
                draw(p->seed, p->first_member + first, sample, padded, std, noise);
            }
            if (isinf(p->p_sigma)) advance(p, &k, sample, count, &m, noise, 1);
            else advance(p, &k, sample, count, &m, noise, 0);
        }
        for (long n = 0; n < count; n++) z[first + n] = m.z[n], peak[first + n] = m.peak[n];
    }
    return 0;
}
