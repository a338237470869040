// One step of DOP853 (Hairer, Norsett, Wanner, Solving ODEs I, sec. II.5) for any scalar, and its
// dense output of order 7 (sec. II.6).
#pragma once
#include <utility>
#include "dual.hpp"

namespace hmsa {
namespace dop853 {
constexpr double node[16] = {
    0.0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726,
    0.3333333333333333, 0.25, 0.3076923076923077, 0.6512820512820513, 0.6, 0.8571428571428571, 1.0,
    1.0, 0.1, 0.2, 0.7777777777777778};
// Rows of the Runge-Kutta matrix, then the weights; then the three additional stages of the dense
// output, and its weights.
constexpr double a[20][16] = {
    {},
    {0.05260015195876773},
    {0.0197250569845379, 0.0591751709536137},
    {0.02958758547680685, 0.0, 0.08876275643042054},
    {0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792},
    {0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242},
    {0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125},
    {0.03709200011850479, 0.0, 0.0, 0.17038392571223998, 0.10726203044637328,
     -0.015319437748624402, 0.008273789163814023},
    {0.6241109587160757, 0.0, 0.0, -3.3608926294469414, -0.868219346841726, 27.59209969944671,
     20.154067550477894, -43.48988418106996},
    {0.47766253643826434, 0.0, 0.0, -2.4881146199716677, -0.590290826836843, 21.230051448181193,
     15.279233632882423, -33.28821096898486, -0.020331201708508627},
    {-0.9371424300859873, 0.0, 0.0, 5.186372428844064, 1.0914373489967295, -8.149787010746927,
     -18.52006565999696, 22.739487099350505, 2.4936055526796523, -3.0467644718982196},
    {2.273310147516538, 0.0, 0.0, -10.53449546673725, -2.0008720582248625, -17.9589318631188,
     27.94888452941996, -2.8589982771350235, -8.87285693353063, 12.360567175794303,
     0.6433927460157636},
    {0.054293734116568765, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003,
     -5.801203960010585, 0.3111643669578199, -0.1521609496625161, 0.20136540080403034,
     0.04471061572777259},
    {0.056167502283047954, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25350021021662483, -0.2462390374708025,
     -0.12419142326381637, 0.15329179827876568, 0.00820105229563469, 0.007567897660545699,
     -0.008298},
    {0.03183464816350214, 0.0, 0.0, 0.0, 0.0, 0.028300909672366776, 0.053541988307438566,
     -0.05492374857139099, 0.0, 0.0, -0.00010834732869724932, 0.0003825710908356584,
     -0.00034046500868740456, 0.1413124436746325},
    {-0.42889630158379194, 0.0, 0.0, 0.0, 0.0, -4.697621415361164, 7.683421196062599,
     4.06898981839711, 0.3567271874552811, 0.0, 0.0, 0.0, -0.0013990241651590145,
     2.9475147891527724, -9.15095847217987},
    {-8.428938276109013, 0.0, 0.0, 0.0, 0.0, 0.5667149535193777, -3.0689499459498917,
     2.38466765651207, 2.117034582445028, -0.871391583777973, 2.2404374302607883,
     0.6315787787694688, -0.08899033645133331, 18.148505520854727, -9.194632392478356,
     -4.436036387594894},
    {10.427508642579134, 0.0, 0.0, 0.0, 0.0, 242.28349177525817, 165.20045171727028,
     -374.5467547226902, -22.113666853125306, 7.733432668472264, -30.674084731089398,
     -9.332130526430229, 15.697238121770845, -31.139403219565178, -9.35292435884448,
     35.81684148639408},
    {19.985053242002433, 0.0, 0.0, 0.0, 0.0, -387.0373087493518, -189.17813819516758,
     527.8081592054236, -11.57390253995963, 6.8812326946963, -1.0006050966910838,
     0.7777137798053443, -2.778205752353508, -60.19669523126412, 84.32040550667716,
     11.99229113618279},
    {-25.69393346270375, 0.0, 0.0, 0.0, 0.0, -154.18974869023643, -231.5293791760455,
     357.6391179106141, 93.40532418362432, -37.45832313645163, 104.0996495089623,
     29.8402934266605, -43.53345659001114, 96.32455395918828, -39.17726167561544,
     -149.72683625798564}};
constexpr double e3[12] = {
    -0.18980075407240762, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003,
    -5.801203960010585, -0.4226823213237919, -0.1521609496625161, 0.20136540080403034,
    0.02265179219836082};
constexpr double e5[12] = {
    0.01312004499419488, 0.0, 0.0, 0.0, 0.0, -1.2251564463762044, -0.4957589496572502,
    1.6643771824549864, -0.35032884874997366, 0.3341791187130175, 0.08192320648511571,
    -0.022355307863886294};

// x += weight k, skipped at compile time if the weight is 0.
template <int I, int J, class R> HMSA_INLINE void add(R &x, const R &k)
{
    if constexpr (J == 0)
        x = a[I][0] * k;
    else if constexpr (a[I][J] != 0)
        x = x + a[I][J] * k;
}
}  // namespace dop853

// The number of scalars in a state: values, then derivatives.
template <class S> constexpr int size_of = sizeof(S) / sizeof(real<S>);

// f(i, y, k): derivative k of state y at node i of the step. Returns the error in units of rtol.
template <class S, int W, int stages = 12> struct Step {
    using R = real<S>;
    // States of more than three values, or with more than one derivative each, share one code: it
    // loops over the stages and over the values in use.
    static constexpr bool unrolled = W <= 3 && count_of<S> <= 1 && stages == 12;
    static constexpr bool pairs = sizeof(Pair<R>) > sizeof(R);
    static_assert(unrolled || !pairs || W * size_of<S> % 2 == 0, "no room for the last pair");
    int in_use = W;
    HMSA_INLINE int width() const { return unrolled || (!pairs && W <= 3) ? W : in_use; }
    void use(int numbers)
    {
        in_use = numbers;
        if constexpr (!unrolled)
            std::memset(static_cast<void *>(k), 0, sizeof k);
    }
    S k[stages][W];
    // A row of the tableau for value m of a state, or for a pair from m on.
    template <class V> HMSA_INLINE static V load(const S *x, int m)
    {
        V numbers;
        std::memcpy(&numbers, reinterpret_cast<const R *>(x) + m, sizeof numbers);
        return numbers;
    }
    template <class V, int I, int... J>
    HMSA_INLINE V row(int m, std::integer_sequence<int, J...>) const
    {
        V x{};
        (dop853::add<I, J>(x, load<V>(k[J], m)), ...);
        return x;
    }
    template <class V, int I> HMSA_INLINE void put(const S *y, const R &h, S *x, int m) const
    {
        V sum = load<V>(y, m);
        if constexpr (I > 1)
            sum = sum + h * row<V, I>(m, std::make_integer_sequence<int, I - 1>());
        // The latest stage is added last, when the other terms are ready.
        sum = sum + (dop853::a[I][I - 1] * h) * load<V>(k[I - 1], m);
        std::memcpy(reinterpret_cast<R *>(x) + m, &sum, sizeof sum);
    }
    template <int I> HMSA_INLINE void stage(const S *y, const R &h, S *x) const
    {
        const int numbers = width() * size_of<S>, paired = pairs ? (numbers + !unrolled) / 2 * 2 : 0;
        for (int m = 0; m < paired; m += 2)
            put<Pair<R>, I>(y, h, x, m);
        if constexpr (unrolled || !pairs)
            for (int m = paired; m < numbers; m++)
                put<R, I>(y, h, x, m);
    }
    template <int I, class F> HMSA_INLINE void one(const F &f, const S *y, const R &h)
    {
        S x[W];
        stage<I>(y, h, x);
        f(I, x, k[I]);
    }
    template <class F, int... I>
    HMSA_INLINE void all(const F &f, const S *y, const R &h, std::integer_sequence<int, I...>)
    {
        (one<I + 1>(f, y, h), ...);
    }
    template <int... I>
    HMSA_INLINE void pick(int i, const S *y, const R &h, S *x, std::integer_sequence<int, I...>) const
    {
        ((i == I + 1 ? stage<I + 1>(y, h, x) : void()), ...);
    }
    template <class F> HMSA_INLINE void move(const F &f, const S *y, const R &h, S *end)
    {
        if constexpr (unrolled) {
            f(0, y, k[0]);
            all(f, y, h, std::make_integer_sequence<int, 11>());
        } else
            for (int i = 0; i < 12; i++) {
                pick(i, y, h, end, std::make_integer_sequence<int, 11>());
                f(i, i ? end : y, k[i]);
            }
        stage<12>(y, h, end);
    }
    // Coefficients of the dense output for the first values of a state; k[12] is the final slope.
    template <class F, int room, int... I> HMSA_INLINE void spread(const F &f, const S *y, const R &h, const S *end,
        int numbers, R (*to)[room], std::integer_sequence<int, I...>)
    {
        S x[W];
        for (int i = 13; i < 16; i++) {
            pick(i, y, h, x, std::make_integer_sequence<int, 15>());
            f(i, x, k[i]);
        }
        using V = Pair<R>;
        for (int m = 0; m < numbers; m += 1 + pairs) {
            const V all = load<V>(end, m) - load<V>(y, m), first = h * load<V>(k[0], m) - all;
            const V rows[] = {all, first, all - h * load<V>(k[12], m) - first,
                h * row<V, 16 + I>(m, std::make_integer_sequence<int, 16>())...};
            for (int i = 0; i < 7; i++)
                std::memcpy(to[i] + m, rows + i, sizeof(V));
        }
    }
    // Evaluates at the fraction x of the step.
    template <int room> HMSA_INLINE static void between(
        double x, const S *y, int numbers, const R (*by)[room], S *at)
    {
        for (int m = 0; m < numbers; m++) {
            R sum = x * by[6][m];
            for (int i = 5; i >= 0; i--)
                sum = (sum + by[i][m]) * (i % 2 ? 1 - x : x);
            reinterpret_cast<R *>(at)[m] = load<R>(y, m) + sum;
        }
    }
    // The error of the first two values, the second of which is scaled by ``fastest``.
    template <class F> HMSA_INLINE double scaled(
        const F &f, const S *y, double h, double rtol, double fastest, S *end)
    {
        move(f, y, R(R{} + h), end);
        double n5 = 0, n3 = 0;
        for (int w = 0; w < 2; w++) {
            double d5 = 0, d3 = 0;
            for (int j = 0; j < 12; j++) {
                d5 += dop853::e5[j] * get(value(k[j][w]), 0);
                d3 += dop853::e3[j] * get(value(k[j][w]), 0);
            }
            const double scale = 1 / (rtol * ((w ? fastest : 1) + abs(get(value(end[w]), 0))));
            n5 += d5 * scale * (d5 * scale);
            n3 += d3 * scale * (d3 * scale);
        }
        return h * n5 / sqrt(2 * (n5 + 0.01 * n3) + 1e-300);
    }
    template <class F> HMSA_INLINE R operator()(const F &f, const S *y, const R &h, const R &rtol, S *end)
    {
        move(f, y, h, end);
        R n5{}, n3{};
        for (int w = 0; w < width(); w++) {
            R d5 = dop853::e5[0] * value(k[0][w]), d3 = dop853::e3[0] * value(k[0][w]);
            for (int j = 5; j < 12; j++) {
                d5 = d5 + dop853::e5[j] * value(k[j][w]);
                d3 = d3 + dop853::e3[j] * value(k[j][w]);
            }
            const R scale = 1.0 / (rtol * (1.0 + abs(value(end[w]))));
            d5 = d5 * scale;
            d3 = d3 * scale;
            n5 = n5 + d5 * d5;
            n3 = n3 + d3 * d3;
        }
        return h * n5 / sqrt(R(double(width()) * (n5 + 0.01 * n3) + 1e-300));
    }
};
// Factor on the length of the next step; 0.2 if the error is NaN.
template <class R> HMSA_INLINE R resized(const R &error)
{
    const R x = 0.9 / sqrt(sqrt(sqrt(R(error + 1e-12)))), least = R{} + 0.2, most = R{} + 6.0;
    const R high = select(x > least, x, least);
    return select(high < most, high, most);
}
}  // namespace hmsa
