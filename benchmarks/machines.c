/* The machine's limit for a whole machine: the paper's cascade on every axis of a rotor, sampled, with one sample of
   delay and prediction, in C with SIMD, as fast as we know how to write it.

   The number of radial bearings, of thrust bearings and of bending modes a plane is fixed at compile time, and so is
   the structure of the rotor: an axis along x sees x, beta_y and the modes in x alone, an axis along y the others, and
   the matrices of mass, damping and stiffness are diagonal. A rotor that touches down is frozen. The guards that no
   levitated rotor meets (gap floor, unreachable force) are left out. */

#include "cascade.h"

#ifndef RADIAL
#define RADIAL 2
#define THRUST 1
#define MODES 0
#endif
#define AXES (2 * RADIAL + THRUST)
#define COORDINATES (5 + 2 * MODES)
#define SEEN (2 + MODES) /* coordinates that a radial axis sees */
#define MOST_SUBSTEPS 64

/* The numbers of an axis; the same order in machines.py. */
typedef struct {
    double m, k_z, s_0, i_0, R, g, kappa, a, touchdown;
    double c, k, p_sigma, gamma, p_v, k_i, p_e;
    double u_max, sample_period;
} axis;

/* What machines.py fills in; the same order there. */
typedef struct {
    double sample_period, touchdown, W, load, std_z, std_z_dot, std_i;
    int64_t substeps, samples, load_from, seed;
    double per_mass[COORDINATES], damping[COORDINATES], stiffness[COORDINATES], gyroscopic; /* I_p W */
    double weight[COORDINATES], along_x[COORDINATES], along_y[COORDINATES], along[COORDINATES], start_q[COORDINATES];
    double magnets[AXES][COORDINATES], sensors[AXES][COORDINATES];
    axis axes[AXES];
} problem;

typedef struct { wide q[COORDINATES], q_dot[COORDINATES], i[AXES]; } rotor;

/* The coordinates that an axis sees: x, beta_y and modes in x; y, beta_x and modes in y; or z. */
INLINE int seen(int n, int k) {
    if (n >= 2 * RADIAL) return 2;
    if (k == 0) return n % 2;
    return k == 1 ? 4 - n % 2 : 5 + 2 * (k - 2) + n % 2;
}
INLINE int count(int n) { return n < 2 * RADIAL ? SEEN : 1; }

#define OVER(k, most) _Pragma("GCC unroll 32") for (int k = 0; k < (most); k++)

INLINE wide along(const double row[COORDINATES], const wide *q, int n) {
    wide sum;
    EACH sum.v[j] = (REAL)row[seen(n, 0)] * q[seen(n, 0)].v[j];
    OVER(k, count(n)) if (k) EACH sum.v[j] += (REAL)row[seen(n, k)] * q[seen(n, k)].v[j];
    return sum;
}

/* The rates of rotor and coils under the voltages u; `outside`: the other forces on the coordinates. */
INLINE void rotor_rates(const problem *p, const constants *k, const REAL *outside, const rotor *x, const wide *u, rotor *out) {
    OVER(c, COORDINATES) EACH {
        out->q[c].v[j] = x->q_dot[c].v[j];
        out->q_dot[c].v[j] = all(outside[c]);
        if (c >= 5) out->q_dot[c].v[j] -= (REAL)p->damping[c] * x->q_dot[c].v[j] + (REAL)p->stiffness[c] * x->q[c].v[j];
    }
    EACH out->q_dot[3].v[j] -= (REAL)p->gyroscopic * x->q_dot[4].v[j];
    EACH out->q_dot[4].v[j] += (REAL)p->gyroscopic * x->q_dot[3].v[j];
    OVER(n, AXES) {
        const constants *a = k + n;
        wide z = along(p->magnets[n], x->q, n), z_dot = along(p->magnets[n], x->q_dot, n);
        EACH {
            vec inverse = inverse_of(a->s_0_2 - z.v[j] * z.v[j]), i = x->i[n].v[j];
            vec above = (a->i_0 * z.v[j] + a->s_0 * i) * inverse, below = (a->i_0_s_0 + i * z.v[j]) * inverse;
            vec force = (REAL)p->axes[n].kappa * above * below, motional = z_dot.v[j] * ((a->s_0 - z.v[j]) * inverse) * i;
            out->i[n].v[j] = a->two_per_kappa * (a->s_0 + z.v[j]) * (u[n].v[j] - a->R * i) + 2 * motional;
            OVER(c, count(n)) out->q_dot[seen(n, c)].v[j] += (REAL)p->magnets[n][seen(n, c)] * force;
        }
    }
    OVER(c, COORDINATES) EACH out->q_dot[c].v[j] *= (REAL)p->per_mass[c];
}

INLINE void add(const rotor *x, REAL h, const rotor *k, rotor *out) {
    OVER(c, COORDINATES) out->q[c] = plus(x->q[c], h, k->q[c]);
    OVER(c, COORDINATES) out->q_dot[c] = plus(x->q_dot[c], h, k->q_dot[c]);
    OVER(n, AXES) out->i[n] = plus(x->i[n], h, k->i[n]);
}

/* One RK4 step. `outside`: the other forces at its begin, middle and end. */
INLINE void rotor_step(
    const problem *p, const constants *k, REAL outside[3][COORDINATES], REAL h, rotor *x, const wide *u
) {
    rotor rate, at = *x, sum = *x;
    rotor_rates(p, k, outside[0], &at, u, &rate);
    add(&sum, h / 6, &rate, &sum), add(x, h / 2, &rate, &at);
    rotor_rates(p, k, outside[1], &at, u, &rate);
    add(&sum, h / 3, &rate, &sum), add(x, h / 2, &rate, &at);
    rotor_rates(p, k, outside[1], &at, u, &rate);
    add(&sum, h / 3, &rate, &sum), add(x, h, &rate, &at);
    rotor_rates(p, k, outside[2], &at, u, &rate);
    add(&sum, h / 6, &rate, x);
}

/* Where a rotor touches or touched (or is not a number): the old state at rest. `held`: 1 or 0. */
INLINE void freeze(const problem *p, const rotor *old, rotor *new, wide *held) {
    wide z[AXES];
    OVER(n, AXES) z[n] = along(p->magnets[n], new->q, n);
    EACH {
        vec limit = all((REAL)p->touchdown), one = held->v[j];
        OVER(n, AXES) one = CHOOSE(LESS(magnitude(z[n].v[j]), limit), one, all(0));
        held->v[j] = one;
        mask kept = LESS(all(0), one);
        OVER(c, COORDINATES) new->q[c].v[j] = CHOOSE(kept, new->q[c].v[j], old->q[c].v[j]);
        OVER(c, COORDINATES) new->q_dot[c].v[j] = CHOOSE(kept, new->q_dot[c].v[j], all(0));
        OVER(n, AXES) new->i[n].v[j] = CHOOSE(kept, new->i[n].v[j], old->i[n].v[j]);
    }
}

/* The forces on the coordinates other than the magnets' at a time: weight, unbalance and load. */
static void forces_at(const problem *p, double t, int loaded, REAL *out) {
    double x = p->W * p->W * cos(p->W * t), y = p->W * p->W * sin(p->W * t);
    for (int c = 0; c < COORDINATES; c++)
        out[c] = (REAL)(p->weight[c] + p->along_x[c] * x + p->along_y[c] * y + (loaded ? p->along[c] * p->load : 0));
}

typedef struct {
    REAL q[COORDINATES][BLOCK], q_dot[COORDINATES][BLOCK], i[AXES][BLOCK], i_ref[AXES][BLOCK], u[AXES][BLOCK];
    REAL peak[AXES][BLOCK], held[BLOCK];
} memory;

/* One sample of one block. The voltages that act are those of the sample before. */
INLINE void advance(
    const problem *p, const constants *k, long sample, long members, memory *m, REAL noise[AXES][3][BLOCK], int hard
) {
    REAL h = (REAL)(p->sample_period / (double)p->substeps), outside[MOST_SUBSTEPS][3][COORDINATES];
    const reference still = {0, 0, 0};
    for (long s = 0; s < p->substeps; s++)
        for (int c = 0; c < 3; c++)
            forces_at(p, ((double)sample + ((double)s + 0.5 * c) / (double)p->substeps) * p->sample_period, sample >= p->load_from, outside[s][c]);
    for (long n = 0; n < members; n += GROUP) {
        rotor x, old;
        wide u[AXES], held = load(m->held + n);
        OVER(c, COORDINATES) x.q[c] = load(m->q[c] + n), x.q_dot[c] = load(m->q_dot[c] + n);
        OVER(a, AXES) {
            wide i_ref = load(m->i_ref[a] + n), z = along(p->sensors[a], x.q, a), z_dot = along(p->sensors[a], x.q_dot, a);
            state sensed;
            u[a] = load(m->u[a] + n), x.i[a] = load(m->i[a] + n);
            EACH sensed.z.v[j] = z.v[j] + *(vec *)(noise[a][0] + n + j * LANES);
            EACH sensed.z_dot.v[j] = z_dot.v[j] + *(vec *)(noise[a][1] + n + j * LANES);
            EACH sensed.i.v[j] = x.i[a].v[j] + *(vec *)(noise[a][2] + n + j * LANES);
            sensed = step(k + a, -k[a].g, k[a].T, sensed, u + a);
            store(m->u[a] + n, decided(k + a, still, sensed, &i_ref, hard));
            store(m->i_ref[a] + n, i_ref);
        }
        for (long s = 0; s < p->substeps; s++) {
            OVER(a, AXES) {
                wide z = along(p->magnets[a], x.q, a), peak = load(m->peak[a] + n);
                EACH {
                    vec size = magnitude(z.v[j]);
                    peak.v[j] = CHOOSE(LESS(peak.v[j], size), size, peak.v[j]);
                }
                store(m->peak[a] + n, peak);
            }
            old = x;
            rotor_step(p, k, outside[s], h, &x, u);
            freeze(p, &old, &x, &held);
        }
        OVER(c, COORDINATES) store(m->q[c] + n, x.q[c]), store(m->q_dot[c] + n, x.q_dot[c]);
        OVER(a, AXES) store(m->i[a] + n, x.i[a]);
        store(m->held + n, held);
    }
}

/* Roll out `members` members from rest; `peak` [members][AXES] gets the largest |z| at a substep's start, and `lost`
   [members] whether the rotor touched. Measurement errors are `given` [samples][AXES][3][members], or drawn where that is
   null. Returns 0, or 1 where there are too many substeps. */
int run(const problem *p, long members, double *peak, double *lost, const double *given) {
    constants k[AXES];
    static memory m __attribute__((aligned(64)));
    static REAL noise[AXES][3][BLOCK] __attribute__((aligned(64)));
    const double std[3] = {p->std_z, p->std_z_dot, p->std_i};
    if (p->substeps > MOST_SUBSTEPS) return 1;
    for (int a = 0; a < AXES; a++) k[a] = CONSTANTS_OF(p->axes + a);
    for (long first = 0; first < members; first += BLOCK) {
        long number = members - first < BLOCK ? members - first : BLOCK, padded = (number + GROUP - 1) / GROUP * GROUP;
        m = (memory){0};
        for (long n = 0; n < BLOCK; n++) {
            for (int c = 0; c < COORDINATES; c++) m.q[c][n] = (REAL)p->start_q[c];
            m.held[n] = 1;
        }
        for (long sample = 0; sample < p->samples; sample++) {
            for (long a = 0; a < AXES; a++) {
                if (!given) draw(p->seed + a, first, sample, padded, std, noise[a]);
                for (long c = 0; given && c < 3; c++)
                    for (long n = 0; n < number; n++)
                        noise[a][c][n] = (REAL)given[((sample * AXES + a) * 3 + c) * members + first + n];
            }
            if (isinf(p->axes[0].p_sigma)) advance(p, k, sample, number, &m, noise, 1);
            else advance(p, k, sample, number, &m, noise, 0);
        }
        for (long n = 0; n < number; n++) {
            for (int a = 0; a < AXES; a++) peak[(first + n) * AXES + a] = (double)m.peak[a][n];
            lost[first + n] = m.held[n] > 0 ? 0 : 1;
        }
    }
    return 0;
}
