// Rollouts through functions that are fixed for a plan, in one pass and in single precision.
//
// `dynamics/deep_gp/compiled_rollout.py` packs what `PathwiseSampler` drew into a Task and calls `rollout` for one
// particle and a range of candidates; several threads may do so at the same time. Every candidate's trajectory is
// independent of the others, so a call runs through all steps by itself. Per step and layer each point goes through
//
//     f(x) = sum_m k(argument_m(x)) kernel_out_m
//          + sum_i (cos(2 pi turns_i(x)) cosine_out_i + sin(2 pi turns_i(x)) sine_out_i) + linear_out x
//
// with argument_m = offset_m + c |x|^2 + centre_m . x and turns_i = frequency_i . x. Blocks of up to VECTORS LANES points
// and UNITS inducing inputs (or WAVES frequencies) stay in registers from the first product over the kernel to the second
// product: nothing of the size "points x inducing inputs" is ever written to memory. The products take the processor's
// multipliers all the time that they last, and more than half of the whole. So the kernels have as few multiplications
// as may be, hence powers of two instead of exp and a table instead of a longer polynomial; every frequency has its cosine
// and its sine at once; and a block at the end is only as wide as it must be.
//
// Built on the user's machine with its own vector width (GCC or Clang; see `compiler.py`). NaN goes through.

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <utility>

#if defined(__AVX512F__)
#include <immintrin.h>
#define LANES 16
#define VECTORS 4
#elif defined(__AVX2__)
#include <immintrin.h>
#define LANES 8
#define VECTORS 2
#else
#define LANES 4
#define VECTORS 2
#endif
#define UNITS 4
#define WAVES 2

typedef float vec __attribute__((vector_size(4 * LANES)));
typedef int32_t ivec __attribute__((vector_size(4 * LANES)));

extern "C" {

struct Layer {
  int64_t kernel;             // see `kernel_number`
  float argument_scale;       // c
  int64_t outputs;            // O
  const float *inverse_lengthscale;  // [P, D]
  const float *centres;       // [P, D, M]
  const float *offsets;       // [P, M]
  const float *frequencies;   // [P, D, F / 2], in turns
  const float *kernel_out;    // [T, P, O, M]
  const float *feature_out;   // [T, P, O, F]: of all cosines, then of all sines
  const float *linear_out;    // [T, P, O, D], or null
};

struct Task {
  int64_t observation_size, action_size, input_size;   // S, A, D
  int64_t num_particles, num_candidates, horizon;      // P, K, H
  int64_t num_layers, num_inducing, num_features;      // L, M, F
  int64_t num_functions;                               // T: H, or 1
  const int64_t *input_kind;    // [D]: 0 the number itself, 1 its sine, 2 its cosine, 3 a number of the action,
                                // 4, 5 the part of a vector forwards and to the left of the body
  const int64_t *input_source;  // [D]: which number or vector
  const float *input_mean, *input_scale;               // [D]
  const float *carried, *shift;                        // [S]: s' = carried s + shift + spread out[target]
  const float *spread;                                 // [S]
  const int64_t *target;                               // [S]: which output, or -1
  const float *lowest, *highest;                       // [T]: bounds of the outputs, noise included
  int64_t num_vectors;
  const int64_t *vectors;       // [num_vectors, 3]: where heading, x and y are; what is added to x, y is along the body
  const Layer *layers;                                 // [L]
  const float *noise;                                  // [H', P, T], H' >= H, added to the last layer; or null
  const float *stretch, *centre;                       // [S], or null: from the second step on a state s enters the
                                                       // step as s + stretch (s - centre)
  const float *start;                                  // [P, S]
  const float *actions;                                // [H, A, K], K padded to a multiple of `points`
  float *states;                                       // [H + 1, P, K, S]
};
}

namespace {

inline vec all(float value) { return value - vec{}; }  // and not + : that would make +0 of -0, an operation

// Of both, x where it is NaN; and a b + c, where the processor can in one rounding. The compiler fuses nothing by itself
// (`-ffp-contract=off`): it might in blocks of one size and not in those of another.
#if defined(__AVX512F__)
inline vec greater(float low, vec x) { return (vec)_mm512_max_ps((__m512)all(low), (__m512)x); }
inline vec lesser(float high, vec x) { return (vec)_mm512_min_ps((__m512)all(high), (__m512)x); }
inline vec nearest(vec x) { return (vec)_mm512_roundscale_ps((__m512)x, 0); }
inline vec fused(vec a, vec b, vec c) { return (vec)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
#elif defined(__AVX2__)
inline vec greater(float low, vec x) { return (vec)_mm256_max_ps((__m256)all(low), (__m256)x); }
inline vec lesser(float high, vec x) { return (vec)_mm256_min_ps((__m256)all(high), (__m256)x); }
inline vec nearest(vec x) { return (vec)_mm256_round_ps((__m256)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
#if defined(__FMA__)
inline vec fused(vec a, vec b, vec c) { return (vec)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
#else
inline vec fused(vec a, vec b, vec c) { return a * b + c; }
#endif
#else
inline vec greater(float low, vec x) { return x < all(low) ? all(low) : x; }
inline vec lesser(float high, vec x) { return x > all(high) ? all(high) : x; }
inline vec nearest(vec x) {
  for (int i = 0; i < LANES; i++) x[i] = rintf(x[i]);
  return x;
}
inline vec fused(vec a, vec b, vec c) {
#if defined(__FP_FAST_FMAF)
  for (int i = 0; i < LANES; i++) c[i] = fmaf(a[i], b[i], c[i]);
  return c;
#else
  return a * b + c;
#endif
}
#endif
inline vec fused(vec a, float b, vec c) { return fused(a, all(b), c); }
inline vec fused(vec a, vec b, float c) { return fused(a, b, all(c)); }
inline vec fused(vec a, float b, float c) { return fused(a, all(b), all(c)); }

inline vec clamped(vec x, float low, float high) { return lesser(high, greater(low, x)); }

// The square root of x >= 1e-30.
#if defined(__AVX512F__)
// By one step of Newton's method from y = 1 / sqrt(x) to 2^-14, which leaves 1.5 2^-28: with r = x y the root is
// r + r (1/2 - r y/2), and y/2 is one less in the exponent's bits.
inline vec root(vec x) {
  const vec y = (vec)_mm512_rsqrt14_ps((__m512)x), half = (vec)((ivec)y - (1 << 23)), r = x * y;
  return fused(r, fused(-r, half, all(0.5f)), r);
}
// Minus the root, to 2^-14 of it, as a product that is only computed where something is added to it.
struct MinusRoot {
  vec x, y;
  explicit inline MinusRoot(vec x) : x(x), y((vec)_mm512_rsqrt14_ps((__m512)x)) {}
};
inline vec plus(const MinusRoot &root, vec c) {
  return (vec)_mm512_fnmadd_ps((__m512)root.x, (__m512)root.y, (__m512)c);
}
#else
inline vec root(vec x) {
#if defined(__AVX2__)
  return (vec)_mm256_sqrt_ps((__m256)x);
#else
  for (int i = 0; i < LANES; i++) x[i] = sqrtf(x[i]);
  return x;
#endif
}
struct MinusRoot {
  vec value;
  explicit inline MinusRoot(vec x) : value(-root(x)) {}
};
inline vec plus(const MinusRoot &root, vec c) { return root.value + c; }
#endif
inline vec plus(vec x, vec c) { return x + c; }

constexpr double LOG2 = 0.69314718055994530942;
constexpr float FARTHEST = 86.56f;  // exp(-60) = 2^-86.56: what is smaller might become subnormal, and slow

// scale 2^x for -FARTHEST <= x <= 0, to 3e-7 of itself.
#if defined(__AVX512F__)
// x = n + j / 32 + r: a table's 2^(j / 32), a quadratic for 2^r (the best relative one, error 5e-8; as a square, which
// saves a multiplication), and n added to the exponent's bits. Four roundings of at most 6e-8 add to the error: of what
// is squared, of the sum, of the table and of the product.
struct Power {
  // The table, times the quadratic's leading coefficient, less what a shift of the index adds to the mantissa.
  alignas(64) int32_t table[32] = {};
  constexpr explicit Power(double scale) {
    double value = 0.24022474583 * scale;
    for (int j = 0; j < 32; j++, value *= 1.0218971486541166) {  // 2^(1/32)
      int exponent = 127;
      double mantissa = value;
      for (; mantissa < 1.0; exponent--) mantissa *= 2.0;
      for (; mantissa >= 2.0; exponent++) mantissa /= 2.0;
      table[j] = exponent * (1 << 23) + (int32_t)((mantissa - 1.0) * (1 << 23) + 0.5) - j * (1 << 18);
    }
  }
  template <class X>
  inline vec operator()(X x) const {
    const vec shifted = plus(x, all(393216.0f));  // 1.5 2^18, whose last bit is 1 / 32
    const vec t = plus(x, 393216.0f - shifted) + 1.4427267707f;
    const ivec index = (ivec)shifted, power = (ivec)_mm512_permutex2var_epi32(
        _mm512_load_si512(table), (__m512i)index, _mm512_load_si512(table + 16));
    return fused(t, t, 2.0813079468f) * (vec)(power + (index << 18));
  }
};
#else
// x = n + r, a polynomial for 2^r (the best relative one, error 7e-8, and as much from its last sums), and n added to the
// exponent's bits.
struct Power {
  float scale;
  constexpr explicit Power(double scale) : scale((float)scale) {}
  template <class X>
  inline vec operator()(X x) const {
    const vec n = nearest(plus(x, vec{})), r = plus(x, -n);
    vec p = fused(r, 1.3276471874e-3f, 9.6755413335e-3f);
    p = fused(p, r, 5.5507132739e-2f);
    p = fused(p, r, 2.4022119724e-1f);
    p = fused(p, r, 6.9314696706e-1f);
    p = fused(p, r, 1.0000000717f);
    return scale * (vec)((ivec)p + (__builtin_convertvector(n, ivec) << 23));
  }
};
#endif

// cos(pi x) and sin(pi x) to 3e-7: x = n + r with |r| <= 1/2, the best polynomials in r^2 (errors 5e-8 and 3e-9; what they
// add up is at most 1.6, and rounded thrice), and the sign of (-1)^n.
inline void wave(vec x, vec &cosine, vec &sine) {
  const vec n = nearest(x), r = x - n, u = r * r;
  const ivec sign = __builtin_convertvector(n, ivec) << 31;
  vec c = fused(u, 0.21969679861f, -1.33188016125f);
  vec s = fused(u, 0.07722014487f, -0.59804518384f);
  c = fused(c, u, 4.05841191417f);
  s = fused(s, u, 2.55003137933f);
  c = fused(c, u, -4.93479285868f);
  s = fused(s, u, -5.16770687910f);
  c = fused(c, u, 0.99999995347f);
  s = fused(s, u, 3.14159258005f);
  cosine = (vec)((ivec)c ^ sign);
  sine = (vec)((ivec)(s * r) ^ sign);
}

// Of an angle in radians, less its whole turns: 2 pi in two parts, so that large angles keep their digits.
inline void direction(vec angle, vec &cosine, vec &sine) {
  const vec n = nearest(angle * 0.159154943f);
  const vec r = fused(n, -1.9353072e-3f, fused(n, -6.28125f, angle));
  wave(r * 0.318309886f, cosine, sine);
}

// Kernels with unit variance to 4e-7, by the names of gp/kernels.py, which has their formulas; `correlation_` there says
// what the range is for. The argument is unit c r^2, with the unit such that exponents are those of two. A new one is a
// struct here and its place in KERNEL_TYPES.
constexpr Power power_of_two(1.0);

struct RBF {
  static constexpr const char *name = "rbf";
  static constexpr double unit = 1.0 / LOG2;
  static inline vec correlation(vec argument) { return power_of_two(clamped(argument, -FARTHEST, 0.0f)); }
};

// Of a Matern kernel s / log 2 with s = sqrt(2 nu) r, and its square, which may not vanish.
constexpr double MATERN_UNIT = 1.0 / (LOG2 * LOG2);
inline vec square(vec argument) { return clamped(argument, 1e-30f, FARTHEST * FARTHEST); }

struct Matern12 {
  static constexpr const char *name = "matern12";
  static constexpr double unit = MATERN_UNIT;
  static inline vec correlation(vec argument) { return power_of_two(-root(square(argument))); }
};

// (1 + s) exp(-s) from a rough s' = s + e, to the first order in s^2 - s'^2: the value's derivative by s^2 is
// -exp(-s) / 2, so that
//
//     (1 + s) exp(-s) = exp(-s') (1 + s' - (s^2 - s'^2) / 2) - exp(-s) s e^2 / 2 + ...,
//
// where e = 2^-14 s leaves 3e-9. With s' = q log 2 and h = 1 / log 2 the bracket is, up to a factor of the table,
// (q + h)^2 + h^2 - argument.
struct Matern32 {
  static constexpr const char *name = "matern32";
  static constexpr double unit = MATERN_UNIT;
  static inline vec correlation(vec argument) {
    static constexpr Power power(LOG2 * LOG2 / 2.0);
    constexpr float h = 1.0 / LOG2;
    const vec a = square(argument);
    const MinusRoot q(a);
    const vec p = plus(q, all(-h));
    return fused(p, p, h * h - a) * power(q);
  }
};

struct Matern52 {
  static constexpr const char *name = "matern52";
  static constexpr double unit = MATERN_UNIT;
  static inline vec correlation(vec argument) {
    const vec q = root(square(argument));
    return fused(fused(q, (float)(LOG2 * LOG2 / 3.0), (float)LOG2), q, 1.0f) * power_of_two(-q);
  }
};

struct Matern72 {
  static constexpr const char *name = "matern72";
  static constexpr double unit = MATERN_UNIT;
  static inline vec correlation(vec argument) {
    const vec q = root(square(argument));
    const vec p = fused(q, (float)(LOG2 * LOG2 * LOG2 / 15.0), (float)(LOG2 * LOG2 * 0.4));
    return fused(fused(p, q, (float)LOG2), q, 1.0f) * power_of_two(-q);
  }
};

#define KERNEL_TYPES RBF, Matern72, Matern52, Matern32, Matern12

// A layer's functions of one particle and step, in the order in which `evaluate` reads them.
struct Functions {
  float argument_scale;
  int64_t outputs;
  const float *inverse_lengthscale;  // [D]
  int64_t unit_blocks, wave_blocks;  // M / UNITS and F / 2 / WAVES, what is missing padded with zeros
  float *units;                      // [unit_blocks, 1 + D + O, UNITS]: offsets, centres, and what goes out
  float *waves;                      // [wave_blocks, D + 2 O, WAVES]: frequencies, and what goes out
  const float *linear;               // [O, D], or null
};

// One block of columns of the first product, for V LANES points, added to the values.
template <int N, int V>
inline void first_product(const vec *x, const float *&weights, int64_t inputs, vec (&values)[N][V]) {
  for (int64_t d = 0; d < inputs; d++, weights += N)
#pragma GCC unroll 4
    for (int j = 0; j < N; j++)
#pragma GCC unroll 4
      for (int v = 0; v < V; v++) values[j][v] = fused(x[d * V + v], weights[j], values[j][v]);
}

// out [O, V] of V LANES points, whose inputs over the lengthscales are x [D, V].
template <class Kernel, int V>
void evaluate(const Functions &of, int64_t inputs, const vec *x, vec *out) {
  vec square[V] = {};
  for (int64_t d = 0; d < inputs; d++)
    for (int v = 0; v < V; v++) square[v] = fused(x[d * V + v], x[d * V + v], square[v]);
  for (int v = 0; v < V; v++) square[v] *= of.argument_scale;
  for (int64_t o = 0; o < of.outputs; o++)
    for (int v = 0; v < V; v++) {
      vec sum = {};
      for (int64_t d = 0; of.linear && d < inputs; d++) sum = fused(x[d * V + v], of.linear[o * inputs + d], sum);
      out[o * V + v] = sum;
    }

  const float *weights = of.units;
  for (int64_t block = 0; block < of.unit_blocks; block++) {
    vec values[UNITS][V];
#pragma GCC unroll 4
    for (int j = 0; j < UNITS; j++)
#pragma GCC unroll 4
      for (int v = 0; v < V; v++) values[j][v] = square[v] + weights[j];
    first_product(x, weights += UNITS, inputs, values);
#pragma GCC unroll 4
    for (int j = 0; j < UNITS; j++)
#pragma GCC unroll 4
      for (int v = 0; v < V; v++) values[j][v] = Kernel::correlation(values[j][v]);
    for (int64_t o = 0; o < of.outputs; o++, weights += UNITS)
#pragma GCC unroll 4
      for (int v = 0; v < V; v++) {
        vec sum = out[o * V + v];
#pragma GCC unroll 4
        for (int j = 0; j < UNITS; j++) sum = fused(values[j][v], weights[j], sum);
        out[o * V + v] = sum;
      }
  }

  weights = of.waves;
  for (int64_t block = 0; block < of.wave_blocks; block++) {
    vec cosines[WAVES][V] = {}, sines[WAVES][V];
    first_product(x, weights, inputs, cosines);
#pragma GCC unroll 4
    for (int j = 0; j < WAVES; j++)
#pragma GCC unroll 4
      for (int v = 0; v < V; v++) wave(cosines[j][v], cosines[j][v], sines[j][v]);
    for (int64_t o = 0; o < of.outputs; o++, weights += 2 * WAVES)
#pragma GCC unroll 4
      for (int v = 0; v < V; v++) {
        vec sum = out[o * V + v];
#pragma GCC unroll 4
        for (int j = 0; j < WAVES; j++) {
          sum = fused(cosines[j][v], weights[j], sum);
          sum = fused(sines[j][v], weights[WAVES + j], sum);
        }
        out[o * V + v] = sum;
      }
  }
}

// The kernels by their numbers. Each layer has its own, so `evaluate` is called through a pointer: once for some ten
// thousand numbers between the two products, which is nothing.
struct Entry {
  const char *name;
  double unit;
  decltype(&evaluate<RBF, 1>) evaluate[VECTORS];  // for 1 to VECTORS vectors of points
};

template <class Kernel, int... V>
constexpr Entry entry(std::integer_sequence<int, V...>) {
  return {Kernel::name, Kernel::unit, {evaluate<Kernel, V + 1>...}};
}

template <class... Kernels>
struct Table {
  static constexpr Entry entries[] = {entry<Kernels>(std::make_integer_sequence<int, VECTORS>())...};
  static constexpr int64_t size = sizeof...(Kernels);
};

using KERNELS = Table<KERNEL_TYPES>;

// Columns first..first+N-1 of weights [rows, columns] times the factor, zeros where there are none.
template <int N>
float *packed(const float *weights, int64_t rows, int64_t columns, int64_t first, double factor, float *to) {
  for (int64_t row = 0; row < rows; row++, weights += columns)
    for (int64_t j = first; j < first + N; j++) *to++ = j < columns ? (float)(weights[j] * factor) : 0.0f;
  return to;
}

// What a function of one step weighs for each layer, packed.
void pack(const Task &task, const Layer &layer, int64_t particle, int64_t function, Functions &of) {
  const int64_t inputs = task.input_size, units = task.num_inducing, waves = task.num_features / 2;
  const double unit = KERNELS::entries[layer.kernel].unit;
  const float *kernel_out = layer.kernel_out + function * layer.outputs * units;
  const float *cosine_out = layer.feature_out + function * layer.outputs * 2 * waves;
  of.argument_scale = (float)(layer.argument_scale * unit);
  of.outputs = layer.outputs;
  of.inverse_lengthscale = layer.inverse_lengthscale + particle * inputs;
  of.linear = layer.linear_out ? layer.linear_out + function * layer.outputs * inputs : nullptr;
  float *to = of.units;
  for (int64_t m = 0; m < units; m += UNITS) {
    to = packed<UNITS>(layer.offsets + particle * units, 1, units, m, unit, to);
    to = packed<UNITS>(layer.centres + particle * inputs * units, inputs, units, m, unit, to);
    to = packed<UNITS>(kernel_out, layer.outputs, units, m, 1.0, to);
  }
  to = of.waves;
  for (int64_t f = 0; f < waves; f += WAVES) {
    to = packed<WAVES>(layer.frequencies + particle * inputs * waves, inputs, waves, f, 2.0, to);  // in half turns
    to = packed<WAVES>(cosine_out, 2 * layer.outputs, waves, f, 1.0, to);
  }
}

// The part of a vector (heading, x, y) forwards, or to the left, of the body.
template <int V>
inline vec along_body(const int64_t *vector, const vec *state, int v, bool forwards) {
  vec cosine, sine;
  direction(state[vector[0] * V + v], cosine, sine);
  const vec x = state[vector[1] * V + v], y = state[vector[2] * V + v];
  return forwards ? cosine * x + sine * y : cosine * y - sine * x;
}

// The standardised inputs [D, V] of V LANES points from their states [S, V] and actions [A, stride].
template <int V>
void encode(const Task &task, const vec *state, const float *actions, int64_t stride, vec *input) {
  for (int64_t d = 0; d < task.input_size; d++) {
    const int64_t kind = task.input_kind[d], source = task.input_source[d];
    for (int v = 0; v < V; v++) {
      vec raw;
      if (kind == 3) {
        memcpy(&raw, actions + source * stride + v * LANES, sizeof raw);
      } else {
        raw = kind > 3 ? along_body<V>(task.vectors + 3 * source, state, v, kind == 4) : state[source * V + v];
        vec cosine, sine;
        if (kind == 1 || kind == 2) {
          direction(raw, cosine, sine);
          raw = kind == 1 ? sine : cosine;
        }
      }
      input[d * V + v] = (raw - task.input_mean[d]) * task.input_scale[d];
    }
  }
}

// The base and what the outputs add to it in dimension i of the state, its shift included.
template <int V>
inline vec with_added(const Task &task, const vec *out, int64_t i, int v, vec base) {
  base += task.shift[i];
  return task.target[i] < 0 ? base : base + out[task.target[i] * V + v] * task.spread[i];
}

// The next state [S, V], in place; `moved` [num_vectors, 2, V] is scratch.
template <int V>
void decode(const Task &task, const vec *out, vec *state, vec *moved) {
  // What is added to a vector turns by the heading before the step, so it is added while that is still in the state.
  for (int64_t k = 0; k < task.num_vectors; k++) {
    const int64_t *vector = task.vectors + 3 * k;
    for (int v = 0; v < V; v++) {
      vec cosine, sine;
      direction(state[vector[0] * V + v], cosine, sine);
      const vec forwards = with_added<V>(task, out, vector[1], v, vec{});
      const vec left = with_added<V>(task, out, vector[2], v, vec{});
      const vec x = state[vector[1] * V + v] * task.carried[vector[1]];
      const vec y = state[vector[2] * V + v] * task.carried[vector[2]];
      moved[2 * k * V + v] = x + (cosine * forwards - sine * left);
      moved[(2 * k + 1) * V + v] = y + (sine * forwards + cosine * left);
    }
  }
  for (int64_t i = 0; i < task.observation_size; i++)
    for (int v = 0; v < V; v++) {
      vec &s = state[i * V + v];
      s = with_added<V>(task, out, i, v, s * task.carried[i]);
    }
  for (int64_t k = 0; k < task.num_vectors; k++)
    for (int part = 0; part < 2; part++)
      for (int v = 0; v < V; v++)
        state[task.vectors[3 * k + 1 + part] * V + v] = moved[(2 * k + part) * V + v];
}

// Transpose the first `count` of V LANES states from [S, V] to rows of S.
template <int V>
void store(const vec *state, int64_t size, int64_t count, float *rows) {
  const float *lanes = (const float *)state;
  for (int64_t i = 0; i < count; i++)
    for (int64_t s = 0; s < size; s++) rows[i * size + s] = lanes[s * V * LANES + i];
}

// What a call computes in, of vectors; of the arrays whose size depends on a block only the largest.
struct Scratch {
  vec *states;                            // [blocks, S, VECTORS]
  vec *input, *scaled, *moved, *out;      // [D, V], [D, V], [num_vectors, 2, V], [max(D, T), V]
  Functions *functions;                   // [L]
};

// One step of V LANES points, of which `count` are candidates, in place.
template <int V>
void advance(const Task &task, int64_t particle, int64_t step, int64_t point, int64_t count, vec *state,
             const Scratch &scratch) {
  const int64_t size = task.observation_size, inputs = task.input_size;
  const int64_t stride = (task.num_candidates + LANES - 1) / LANES * LANES;
  vec *input = scratch.input, *scaled = scratch.scaled, *out = scratch.out;
  if (task.stretch && step > 0)
    for (int64_t s = 0; s < size; s++)
      for (int v = 0; v < V; v++) state[s * V + v] += (state[s * V + v] - task.centre[s]) * task.stretch[s];
  encode<V>(task, state, task.actions + step * task.action_size * stride + point, stride, input);
  for (int64_t l = 0; l < task.num_layers; l++) {
    const Functions &of = scratch.functions[l];
    for (int64_t d = 0; d < inputs; d++)
      for (int v = 0; v < V; v++) scaled[d * V + v] = input[d * V + v] * of.inverse_lengthscale[d];
    KERNELS::entries[task.layers[l].kernel].evaluate[V - 1](of, inputs, scaled, out);
    if (l + 1 < task.num_layers)
      for (int64_t i = 0; i < inputs * V; i++) input[i] += out[i];
  }
  const int64_t outputs = task.layers[task.num_layers - 1].outputs;
  const float *noise = task.noise ? task.noise + (step * task.num_particles + particle) * outputs : nullptr;
  for (int64_t o = 0; o < outputs; o++)
    for (int v = 0; v < V; v++) {
      const vec target = noise ? out[o * V + v] + noise[o] : out[o * V + v];
      out[o * V + v] = clamped(target, task.lowest[o], task.highest[o]);
    }
  decode<V>(task, out, state, scratch.moved);
  store<V>(state, size, count,
           task.states + (((step + 1) * task.num_particles + particle) * task.num_candidates + point) * size);
}

template <int... V>
constexpr std::array<decltype(&advance<1>), VECTORS> advances(std::integer_sequence<int, V...>) {
  return {advance<V + 1>...};
}

void run(const Task &task, int64_t particle, int64_t first, int64_t last, const Scratch &scratch) {
  constexpr auto ADVANCE = advances(std::make_integer_sequence<int, VECTORS>());
  const int64_t size = task.observation_size;
  const float *start = task.start + particle * size;
  float *begins = task.states + (particle * task.num_candidates + first) * size;
  for (int64_t k = first; k < last; k++, begins += size) memcpy(begins, start, size * sizeof(float));
  const int64_t vectors = (last - first + LANES - 1) / LANES;
  for (int64_t step = 0; step < task.horizon; step++) {
    if (step == 0 || task.num_functions > 1)
      for (int64_t l = 0; l < task.num_layers; l++)
        pack(task, task.layers[l], particle, (task.num_functions == 1 ? 0 : step) * task.num_particles + particle,
             scratch.functions[l]);
    // Steps outside, blocks inside: a step's functions are read once, and stay in the cache for all blocks.
    for (int64_t done = 0; done < vectors; done += VECTORS) {
      const int64_t count = vectors - done < VECTORS ? vectors - done : VECTORS, point = first + done * LANES;
      vec *state = scratch.states + done * size;
      if (step == 0)
        for (int64_t s = 0; s < size; s++)
          for (int64_t v = 0; v < count; v++) state[s * count + v] = all(start[s]);
      const int64_t points = last - point < count * LANES ? last - point : count * LANES;
      ADVANCE[count - 1](task, particle, step, point, points, state, scratch);
    }
  }
}

// Aligned memory, one part after another; without any of it their total size.
struct Memory {
  char *base;
  int64_t used = 0;
  template <class T>
  T *take(int64_t count) {
    T *taken = (T *)(base + used);
    used += (count * sizeof(T) + sizeof(vec) - 1) / sizeof(vec) * sizeof(vec);
    return taken;
  }
};

Scratch laid_out(const Task &task, int64_t count, Memory &memory) {
  const int64_t size = task.observation_size, inputs = task.input_size;
  const int64_t outputs = task.layers[task.num_layers - 1].outputs, widest = inputs > outputs ? inputs : outputs;
  Scratch scratch;
  scratch.states = memory.take<vec>((count + LANES - 1) / LANES * size);
  scratch.input = memory.take<vec>(inputs * VECTORS);
  scratch.scaled = memory.take<vec>(inputs * VECTORS);
  scratch.moved = memory.take<vec>(2 * task.num_vectors * VECTORS);
  scratch.out = memory.take<vec>(widest * VECTORS);
  scratch.functions = memory.take<Functions>(task.num_layers);
  for (int64_t l = 0; l < task.num_layers; l++) {
    const int64_t units = (task.num_inducing + UNITS - 1) / UNITS, waves = (task.num_features / 2 + WAVES - 1) / WAVES;
    const int64_t out = task.layers[l].outputs;
    float *first = memory.take<float>(units * (1 + inputs + out) * UNITS);
    float *second = memory.take<float>(waves * (inputs + 2 * out) * WAVES);
    if (memory.base) scratch.functions[l] = {0.0f, 0, nullptr, units, waves, first, second, nullptr};
  }
  return scratch;
}

}  // namespace

extern "C" {

// What the number of candidates of a call is best a multiple of, and that of the actions has to be.
int64_t points() { return LANES; }

// The number by which a Layer names this kernel; -1 if it is not here.
int64_t kernel_number(const char *name) {
  for (int64_t i = 0; i < KERNELS::size; i++)
    if (!strcmp(KERNELS::entries[i].name, name)) return i;
  return -1;
}

// Roll out the candidates first..last-1 of one particle. Returns 0, or 1 if there was no memory.
int64_t rollout(const Task *task, int64_t particle, int64_t first, int64_t last) {
  Memory size{nullptr};
  laid_out(*task, last - first, size);
  void *memory = nullptr;
  if (posix_memalign(&memory, sizeof(vec), size.used)) return 1;
  Memory taken{(char *)memory};
  run(*task, particle, first, last, laid_out(*task, last - first, taken));
  free(memory);
  return 0;
}
}
