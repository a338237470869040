/*
 * The two-step command (Eq. 13) from rest, several moves in lock-step: the program of two_step.c
 * with GUESS=2 and COARSE, in which each number is a vector over LANES moves. A lane whose move is
 * done takes the next one, so that none waits for another; what lanes decide is scalar.
 *
 *     lanes RTOL REPEATS < moves
 *
 * Prints as two_step.c does, then the share of the time in vector code that the steps had, and
 * the steps per plan.
 */
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#ifndef LANES
#define LANES 8
#endif
#define COARSE 1e-7

typedef double vec __attribute__((vector_size(8 * LANES)));
typedef long long mask __attribute__((vector_size(8 * LANES)));
#define PICK(which, a, b) ((vec)(((which) & (mask)(a)) | (~(which) & (mask)(b))))
/* Of each lane's move: 3 zeta c1, c1, 1/J_lim. */
typedef struct { vec damping, c1, i_j; } material;

static inline void derivative(const vec y[4], vec beta, const material *m, vec out[4])
{
    const vec l = y[0], v = y[1];
    const vec l2 = l * l, l3 = l2 * l;
    const vec lg = l - (l - 1) * (l - 1) * (l + 2) * m->i_j;
    const vec inertia = 1 / (1 + m->c1 * l3);
    const vec r_lg = 1 / lg, r_l = 1 / l;
    const vec elastic = l2 * (l3 - 1) * r_lg;
    const vec damping = m->damping * l2;
    const vec a = (6 * (beta * l3 - elastic) - damping * l * v + 1.5 * v * v * r_l) * inertia;
    const vec d_elastic = (5 * l3 * l - 2 * l - elastic * (1 - 3 * (l2 - 1) * m->i_j)) * r_lg;
    const vec a_l = (6 * (3 * beta * l2 - d_elastic) - 3 * damping * v
        - 1.5 * v * v * r_l * r_l - 3 * a * m->c1 * l2) * inertia;
    const vec a_v = (3 * v * r_l - damping * l) * inertia;
    out[0] = v;
    out[1] = a;
    out[2] = y[3];
    out[3] = a_l * y[2] + a_v * y[3] + 6 * l3 * inertia;
}

static inline vec root(vec x)
{
    vec out;
    for (int i = 0; i < LANES; i++)
        out[i] = __builtin_sqrt(x[i]);
    return out;
}

/* One step of all lanes; error in units of the tolerance, and the factor of the next step. */
static void step(
    const vec y[4], vec beta, vec h, vec rtol, const material *m, vec end[4], vec *start_a,
    vec *error, vec *factor)
{
    vec k[12][4], x[4], e5[2], e3[2];
    derivative(y, beta, m, k[0]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.05260015195876773 * k[0][i]);
    derivative(x, beta, m, k[1]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.0197250569845379 * k[0][i] + 0.0591751709536137 * k[1][i]);
    derivative(x, beta, m, k[2]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.02958758547680685 * k[0][i] + 0.08876275643042054 * k[2][i]);
    derivative(x, beta, m, k[3]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.2413651341592667 * k[0][i] - 0.8845494793282861 * k[2][i] +
            0.924834003261792 * k[3][i]);
    derivative(x, beta, m, k[4]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.037037037037037035 * k[0][i] + 0.17082860872947386 * k[3][i] +
            0.12546768756682242 * k[4][i]);
    derivative(x, beta, m, k[5]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.037109375 * k[0][i] + 0.17025221101954405 * k[3][i] +
            0.06021653898045596 * k[4][i] - 0.017578125 * k[5][i]);
    derivative(x, beta, m, k[6]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.03709200011850479 * k[0][i] + 0.17038392571223998 * k[3][i] +
            0.10726203044637328 * k[4][i] - 0.015319437748624402 * k[5][i] + 0.008273789163814023 *
            k[6][i]);
    derivative(x, beta, m, k[7]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.6241109587160757 * k[0][i] - 3.3608926294469414 * k[3][i] -
            0.868219346841726 * k[4][i] + 27.59209969944671 * k[5][i] + 20.154067550477894 *
            k[6][i] - 43.48988418106996 * k[7][i]);
    derivative(x, beta, m, k[8]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (0.47766253643826434 * k[0][i] - 2.4881146199716677 * k[3][i] -
            0.590290826836843 * k[4][i] + 21.230051448181193 * k[5][i] + 15.279233632882423 *
            k[6][i] - 33.28821096898486 * k[7][i] - 0.020331201708508627 * k[8][i]);
    derivative(x, beta, m, k[9]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (-0.9371424300859873 * k[0][i] + 5.186372428844064 * k[3][i] +
            1.0914373489967295 * k[4][i] - 8.149787010746927 * k[5][i] - 18.52006565999696 *
            k[6][i] + 22.739487099350505 * k[7][i] + 2.4936055526796523 * k[8][i] -
            3.0467644718982196 * k[9][i]);
    derivative(x, beta, m, k[10]);
    for (int i = 0; i < 4; i++)
        x[i] = y[i] + h * (2.273310147516538 * k[0][i] - 10.53449546673725 * k[3][i] -
            2.0008720582248625 * k[4][i] - 17.9589318631188 * k[5][i] + 27.94888452941996 * k[6][i]
            - 2.8589982771350235 * k[7][i] - 8.87285693353063 * k[8][i] + 12.360567175794303 *
            k[9][i] + 0.6433927460157636 * k[10][i]);
    derivative(x, beta, m, k[11]);
    for (int i = 0; i < 4; i++)
        end[i] = y[i] + h * (0.054293734116568765 * k[0][i] + 4.450312892752409 * k[5][i] +
            1.8915178993145003 * k[6][i] - 5.801203960010585 * k[7][i] + 0.3111643669578199 *
            k[8][i] - 0.1521609496625161 * k[9][i] + 0.20136540080403034 * k[10][i] +
            0.04471061572777259 * k[11][i]);
    for (int i = 0; i < 2; i++)
        e5[i] = 0.01312004499419488 * k[0][i] - 1.2251564463762044 * k[5][i] - 0.4957589496572502 *
            k[6][i] + 1.6643771824549864 * k[7][i] - 0.35032884874997366 * k[8][i] +
            0.3341791187130175 * k[9][i] + 0.08192320648511571 * k[10][i] - 0.022355307863886294 *
            k[11][i];
    for (int i = 0; i < 2; i++)
        e3[i] = -0.18980075407240762 * k[0][i] + 4.450312892752409 * k[5][i] + 1.8915178993145003 *
            k[6][i] - 5.801203960010585 * k[7][i] - 0.4226823213237919 * k[8][i] -
            0.1521609496625161 * k[9][i] + 0.20136540080403034 * k[10][i] + 0.02265179219836082 *
            k[11][i];    *start_a = k[0][1];
    vec n5 = {0}, n3 = {0};
    for (int i = 0; i < 2; i++) {
        const vec scale = 1 / (rtol * (1 + root(end[i] * end[i])));
        n5 += e5[i] * e5[i] * scale * scale;
        n3 += e3[i] * e3[i] * scale * scale;
    }
    const vec size = h * n5 / root(2 * (n5 + 0.01 * n3) + 1e-300);
    *error = size;
    *factor = 0.9 / root(root(root(size + 1e-12)));
}

typedef struct {
    int index, fresh, direction, n, pass;
    double l, target, zeta, c1, i_j, beta_1, low, high, d, tolerance, h, size, first_h;
} lane;

static double moves[100000][5], beta_p[100000], tau_p[100000];
static int passes[100000];
static long steps;

static double force(const lane *x, double l)
{
    return (l - 1 / (l * l)) / (1 - (2 / l + l * l - 3) * x->i_j);
}

static double energy(const lane *x, double l)
{
    return -0.5 / x->i_j * log1p(-(2 / l + l * l - 3) * x->i_j);
}

static double frequency(const lane *x, double l)
{
    const double g = 1 - (2 / l + l * l - 3) * x->i_j, f = l - 1 / (l * l);
    const double stiffness = (1 + 2 / (l * l * l)) / g + 2 * f * f * x->i_j / (g * g);
    return sqrt(6 * stiffness / (1 / (l * l * l) + x->c1));
}

static double first_guess(const lane *x)
{
    const double l = x->l, target = x->target;
    const double beta = (energy(x, target) - energy(x, l)) / (target - l);
    const double delta = fabs(x->beta_1 - beta), half = 0.5 * (l + target);
    const double kinetic = energy(x, l) + beta * (half - l) - energy(x, half);
    const double fastest = sqrt(fmax(12 * kinetic / (1 / (half * half * half) + x->c1), 0));
    const double xi = 0.25 * x->zeta * x->c1 * fastest / delta;
    const double decay = xi < 0.9 ? exp(-acos(-1) * xi / sqrt(1 - xi * xi)) : 1e-3;
    return delta * 2 * decay / (1 + decay);
}

/* State of all lanes. */
static vec y[4], beta, h, t, sign, rtol_of;
static mask inside;
static material m;

static void begin_pass(lane *x, int i)
{
    t[i] = inside[i] = x->n = 0;
    sign[i] = x->direction;
    h[i] = x->first_h * sqrt(sqrt(sqrt(x->tolerance)));
    y[0][i] = x->l;
    y[1][i] = y[2][i] = y[3][i] = 0;
    beta[i] = x->beta_1 - x->direction * x->d;
    rtol_of[i] = x->tolerance;
}

static void begin_move(lane *x, int i, int index, double rtol)
{
    const double *move = moves[index];
    *x = (lane){.index = index, .l = move[0], .target = move[1], .zeta = move[2], .c1 = move[4],
        .i_j = 1 / move[3], .pass = 1, .tolerance = fmax(rtol, COARSE)};
    x->direction = x->target > x->l ? 1 : -1;
    x->beta_1 = force(x, x->target);
    x->high = fabs(x->beta_1 - force(x, x->l));
    x->d = first_guess(x);
    x->first_h = 4 / (frequency(x, x->l) + 3 * x->zeta);
    m.damping[i] = 3 * x->zeta * x->c1;
    m.c1[i] = x->c1;
    m.i_j[i] = x->i_j;
    begin_pass(x, i);
}

/* After a pass: the next load. Returns 1 when the move is done. */
static int end_pass(lane *x, int i, int found, double end, double slope, double rtol)
{
    double change = INFINITY;
    if (found) {
        const double excess = x->direction * (end - x->target);
        if (fabs(excess) > 1e3 * x->tolerance)
            *(excess > 0 ? &x->low : &x->high) = x->d;
        change = excess / slope;
    } else
        x->high = x->d;
    double next = x->d + change;
    if (!(x->low < next && next < x->high))
        next = 0.5 * (x->low + x->high);
    const double relative = fabs(next - x->d) / x->d;
    x->d = next;
    if ((x->tolerance <= rtol && relative * relative <= 0.01 * rtol && x->pass > 1)
            || x->pass == 80) {
        beta_p[x->index] = x->beta_1 - x->direction * x->d;
        tau_p[x->index] = t[i];
        passes[x->index] = x->pass;
        return 1;
    }
    if (relative < 0.1) {
        x->tolerance = fmax(rtol, fmin(x->tolerance, 1e-2 * relative * relative));
        if (x->tolerance < 1e3 * rtol)
            x->tolerance = rtol;
    }
    x->pass++;
    begin_pass(x, i);
    return 0;
}

/* What a lane at its turning point makes of a step. Returns 1 when its move is done. */
static int decide(lane *x, int i, const vec end[4], double a, double rtol)
{
    const double v = y[1][i], v_end = end[1][i];
    if (!inside[i]) {
        const double all = h[i], r_h = 1 / (all * all);
        double dt = all * v / (v - v_end);
        x->size = fabs(v) > fabs(v_end) ? fabs(v) : fabs(v_end);
        if (x->direction * a < 0) {
            const double c = (v_end - v - a * all) * r_h;
            const double r = a * a - 4 * c * v;
            const double better = 2 * v / (-a + x->direction * sqrt(r > 0 ? r : 0));
            if (r > 0 && better > 0 && better <= all)
                dt = better;
        }
        inside[i] = -1;
        x->n = 0;
        x->h = all;
        h[i] = dt;
        return 0;
    }
    /* Inside the last step: Newton on the time. */
    for (int j = 0; j < 4; j++)
        y[j][i] = end[j][i];
    t[i] += h[i];
    const double l = y[0][i], w = y[1][i], l3 = l * l * l;
    const double slope = (6 * (beta[i] * l3 - force(x, l) * l3) - m.damping[i] * l3 * w
        + 1.5 * w * w / l) / (1 + x->c1 * l3);
    x->n++;
    if (x->direction * slope >= 0 && x->n < 12) {
        h[i] = 0.25 * x->h;
        return 0;
    }
    const double dt = -w / slope;
    if (fabs(w) > 1e-6 * x->size && x->n < 12) {
        h[i] = dt;
        return 0;
    }
    t[i] += dt;
    return end_pass(x, i, 1, l + 0.5 * w * dt, y[2][i] + y[3][i] * dt, rtol);
}

static void plan(int count, double rtol)
{
    lane lanes[LANES];
    int next = 0, left = count;
    for (int i = 0; i < LANES; i++) {
        begin_move(&lanes[i], i, next < count ? next : 0, rtol);
        lanes[i].fresh = next < count;
        next += lanes[i].fresh;
    }
    /* Lanes without a move repeat the first one. */
    while (left > 0) {
        vec end[4], a, error, factor;
        step(y, beta, h, rtol_of, &m, end, &a, &error, &factor);
        steps += LANES;
        const mask good = error <= 1, turns = (sign * y[1] > 0) & (sign * end[1] <= 0);
        const mask goes_on = good & ~turns & ~inside, again = ~good & ~inside;
        for (int j = 0; j < 4; j++)
            y[j] = PICK(goes_on, end[j], y[j]);
        t += PICK(goes_on, h, 0 * h);
        const vec least = PICK(factor > 0.2, factor, 0 * h + 0.2);
        h = PICK(goes_on | again, h * PICK(least < 6, least, 0 * h + 6), h);
        const mask special = ~(goes_on | again);
        for (int i = 0; i < LANES; i++)
            if (special[i] && decide(&lanes[i], i, end, a[i], rtol)) {
                left -= lanes[i].fresh;
                begin_move(&lanes[i], i, next < count ? next : 0, rtol);
                lanes[i].fresh = next < count;
                next += lanes[i].fresh;
            }
    }
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return 1e9 * t.tv_sec + t.tv_nsec;
}

int main(int argc, char **argv)
{
    int count = 0;
    if (argc != 3 || atoi(argv[2]) < 1) {
        fprintf(stderr, "usage: %s RTOL REPEATS < moves\n", argv[0]);
        return 2;
    }
    const double rtol = atof(argv[1]);
    const int repeats = atoi(argv[2]);
    while (count < 100000 && scanf("%lf %lf %lf %lf %lf", &moves[count][0], &moves[count][1],
            &moves[count][2], &moves[count][3], &moves[count][4]) == 5)
        count++;
    double least = INFINITY;
    for (int n = 0; n < repeats; n++) {
        const double begin = now();
        steps = 0;
        plan(count, rtol);
        least = fmin(least, (now() - begin) / count);
    }
    /* The steps alone. */
    vec end[4], a, error, factor, sum = {0};
    begin_move(&(lane){0}, 0, 0, rtol);
    for (int i = 1; i < LANES; i++)
        begin_move(&(lane){0}, i, i < count ? i : 0, rtol);
    const double begin = now();
    for (int n = 0; n < 200000; n++) {
        step(y, beta, h, rtol_of, &m, end, &a, &error, &factor);
        y[0] += 1e-9 * (end[0] - y[0]);
        sum += error;
    }
    const double alone = (now() - begin) / 200000 / LANES;
    for (int i = 0; i < count; i++)
        printf("%.17g %.17g %d\n", beta_p[i], tau_p[i], passes[i]);
    fprintf(stderr, "%g", sum[0] * 0);
    printf("%.1f %.1f %.2f\n", least, alone, (double)steps / count);
    return 0;
}
