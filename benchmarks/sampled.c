/* The machine's limit on a processor: the paper's cascade sampled, with one sample of delay and prediction, in C with
   SIMD, as fast as we know how to write it.

   A sample at a time, all in registers: sensors are read, the laws step on the estimate carried over the delay by one
   RK4 step of the model, and the plant alone moves under the voltage of the sample before. v(z, i) is written as a
   product, v = 4 (i_0 z + s_0 i)(i_0 s_0 + i z)/(s_0^2 - z^2)^2, so that there is one division per evaluation. A rotor
   that touches down is frozen. The guards that no levitated rotor meets (gap floor, unreachable force) are left out. */

#include "cascade.h"

#define MOST_SUBSTEPS 16

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
    constants k = CONSTANTS_OF(p);
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
