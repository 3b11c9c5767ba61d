/* The paper's cascade on a processor for one axis, in lanes: the plant, its prediction, and the step of the laws. */

#ifndef CASCADE_H
#define CASCADE_H

#include "lanes.h"

#define HALLEY 3

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

/* The constants of an axis from the numbers of a struct with these names. */
#define CONSTANTS_OF(p) (constants){ \
    .s_0 = (REAL)(p)->s_0, .i_0 = (REAL)(p)->i_0, .s_0_2 = (REAL)((p)->s_0 * (p)->s_0), .i_0_s_0 = (REAL)((p)->i_0 * (p)->s_0), \
    .stiff = (REAL)(2 * (p)->k_z / (p)->m), .a_4 = (REAL)(4 * (p)->a), .two_per_kappa = (REAL)(2 / (p)->kappa), \
    .half_kappa = (REAL)((p)->kappa / 2), .R = (REAL)(p)->R, .g = (REAL)(p)->g, .touchdown = (REAL)(p)->touchdown, \
    .u_max = (REAL)(p)->u_max, .T = (REAL)(p)->sample_period, .per_T = (REAL)(1 / (p)->sample_period), \
    .c = (REAL)(p)->c, .demand_z = (REAL)(-2 * (p)->k_z / (p)->m), .per_a = (REAL)(1 / (p)->a), .k = (REAL)(p)->k, \
    .gamma = (REAL)(p)->gamma, .k_i = (REAL)(p)->k_i, \
    .p_sigma = (REAL)(p)->p_sigma, .p_v = (REAL)(p)->p_v, .p_e = (REAL)(p)->p_e, \
    }

#endif
