/* SPDX-License-Identifier: Apache-2.0
 *
 * The same recursion as fhaosmo_ros/core/observer/cascade.pyx in C, for one case: n = 3,
 * Phi = (0, 0, -z3), N = 4 levels, fuzzy_adaptive, explicit. It is written as one would write it
 * for speed (the model is inlined by hand), and serves the benchmark only.
 *
 * State: z_hat[4], z_tilde[4], p[4], q[4], gamma, y, pending: PARTS in core_step.py.
 */
#include <math.h>
#include <string.h>

enum { N = 4, SIZE = 4 * N + 3, KNOTS = 193 };

struct law {
    double lambda[N], alpha[N], inverse_width[N];
    double curves[2][KNOTS];
    double epsilon, gamma_initial, rate, min, dead_zone, leakage;
};

static int step(const struct law *law, double *state, double y, double h, double *eps)
{
    double x[SIZE], m[N], dm[N];
    if (!isfinite(y) || !isfinite(h) || h <= 0.0)
        return 1;
    for (int k = 0; k < SIZE; k++)
        x[k] = state[k];
    const double gamma = x[4 * N];
    m[0] = x[4 * N + 1];
    dm[0] = 0.0;
    for (int i = 1; i < N; i++) {
        m[i] = x[N + i - 1];
        dm[i] = x[3 * N + i - 1];
    }
    h += x[4 * N + 2];
    double loss = 0.0, gradient = 0.0;
    int running = 1;
    for (int i = 0; i < N; i++) {
        const double e = m[i] - x[i], s = dm[i] - x[2 * N + i], a = fabs(e);
        loss += e * e;
        gradient += 2.0 * e * s;
        if (!running)
            continue;
        const double phi = i == 2 ? -m[2] : 0.0, dphi = i == 2 ? -dm[2] : 0.0;
        const double *curve = law->curves[i == 0 ? 0 : 1];
        const double scale = law->inverse_width[i] * (KNOTS - 1), position = a * scale;
        double psi = curve[KNOTS - 1], slope = 0.0;
        if (position < KNOTS - 1) {
            const int j = (int)position;
            const double rise = curve[j + 1] - curve[j];
            psi = curve[j] + (position - j) * rise;
            slope = rise * scale;
        }
        double injection = 0.0, dinjection = 0.0, direction = 0.0;
        if (a > 0.0) {
            const double log_a = log(a), power = exp(gamma * log_a);
            direction = copysign(psi, e);
            injection = law->lambda[i] * power * direction;
            dinjection = injection * log_a
                + law->lambda[i] * power * s * (gamma * fabs(direction) / a + slope);
        }
        x[2 * N + i] += h * (x[3 * N + i] + dinjection + dphi);
        x[3 * N + i] += h * (law->alpha[i] * slope * s);
        x[i] += h * (x[N + i] + injection + phi);
        x[N + i] += h * (law->alpha[i] * direction);
        running = a <= law->epsilon;
    }
    x[4 * N + 1] = y;
    x[4 * N + 2] = 0.0;
    int word = 0;
    for (int k = 2 * N; k < 4 * N; k++)
        if (!(fabs(x[k]) < 1e9))
            word = 64;
    double g = gamma;
    if (word)
        for (int k = 2 * N; k < 4 * N; k++)
            x[k] = 0.0;
    const int rests = loss <= law->dead_zone * law->dead_zone;
    if (law->dead_zone == 0.0 || rests)
        g -= fmin(h * law->leakage, 1.0) * (g - law->gamma_initial);
    if (!word && !rests)
        g -= h * law->rate * gradient;
    if (g <= law->min) {
        g = law->min;
        word |= 16;
    } else if (g >= 1.0) {
        g = 1.0;
        word |= 32;
    }
    x[4 * N] = g;
    for (int k = 0; k < 2 * N; k++)
        if (!isfinite(x[k]))
            return 8;
    for (int k = 0; k < SIZE; k++)
        state[k] = x[k];
    int levels = 0;
    running = 1;
    for (int i = 0; i < N; i++) {
        eps[i] = (i == 0 ? state[4 * N + 1] : state[N + i - 1]) - state[i];
        levels += running;
        running = running && fabs(eps[i]) <= law->epsilon;
    }
    return word | levels << LEVEL_SHIFT;
}

/* Step through `count` samples of period `h`; `eps` and the last status word are the result. */
/* `record` has a row of 21 numbers a sample; the core records 19. */
int run(const struct law *law, double *state, const double *y, double h, long count, double *record)
{
    int word = 0;
    for (long k = 0; k < count; k++, record += 21) {
        word = step(law, state, y[k], h, record + 17);
        memcpy(record, state, 17 * sizeof(double));
    }
    return word;
}
