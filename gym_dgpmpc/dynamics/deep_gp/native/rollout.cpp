// Rollouts through functions that are fixed for a plan, in one pass and in single precision.
//
// `dynamics/deep_gp/compiled_rollout.py` packs what `PathwiseSampler` drew into a Task and calls `rollout` for one
// particle and a range of candidates; several threads may do so at the same time. Every candidate's trajectory is
// independent of the others, so a call runs through all steps by itself. Per step and layer each point goes through
//
//     f(x) = sum_m k(argument_m(x)) kernel_out_m + sum_i cos(2 pi turns_i(x)) feature_out_i
//
// with argument_m = offset_m + c |x|^2 + centre_m . x and turns_i = phase_i + frequency_i . x. Blocks of POINTS points
// and UNITS inducing inputs (or features) stay in registers from the first product over the kernel to the second
// product: nothing of the size "points x inducing inputs" is ever written to memory.
//
// Built on the user's machine with its own vector width (GCC or Clang; see `compiler.py`). NaN goes through.

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>

#if defined(__AVX512F__)
#include <immintrin.h>
#define LANES 16
#define UNITS 8
#elif defined(__AVX2__)
#include <immintrin.h>
#define LANES 8
#define UNITS 4
#else
#define LANES 4
#define UNITS 4
#endif
#define VECTORS 2
#define POINTS (VECTORS * LANES)

typedef float vec __attribute__((vector_size(4 * LANES)));
typedef int32_t ivec __attribute__((vector_size(4 * LANES)));

extern "C" {

struct Layer {
  int64_t kernel;             // see `kernel_number`
  float argument_scale;       // c
  int64_t outputs;            // O
  const float *inverse_lengthscale;  // [P, D]
  const float *centres;       // [P, M / UNITS, D, UNITS], M padded with zeros to a multiple of UNITS
  const float *offsets;       // [P, M]
  const float *frequencies;   // [P, F / UNITS, D, UNITS], in turns
  const float *phases;        // [P, F], in turns
  const float *kernel_out;    // [T, P, O, M]
  const float *feature_out;   // [T, P, O, F]
  const float *linear_out;    // [T, P, O, D], or null
};

struct Task {
  int64_t observation_size, action_size, input_size;   // S, A, D
  int64_t num_particles, num_candidates, horizon;      // P, K, H
  int64_t num_layers, num_inducing, num_features;      // L, and M and F padded
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
  const float *actions;                                // [K, H, A]
  float *states;                                       // [H + 1, P, K, S]
};
}

namespace {

inline vec all(float value) { return vec{} + value; }

#if defined(__AVX512F__)
inline vec square_root(vec x) { return (vec)_mm512_sqrt_ps((__m512)x); }
inline vec nearest(vec x) { return (vec)_mm512_roundscale_ps((__m512)x, 0); }
#elif defined(__AVX2__)
inline vec square_root(vec x) { return (vec)_mm256_sqrt_ps((__m256)x); }
inline vec nearest(vec x) { return (vec)_mm256_round_ps((__m256)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
#else
inline vec square_root(vec x) {
  for (int i = 0; i < LANES; i++) x[i] = sqrtf(x[i]);
  return x;
}
inline vec nearest(vec x) {
  for (int i = 0; i < LANES; i++) x[i] = rintf(x[i]);
  return x;
}
#endif

// Comparisons with NaN are false, so NaN stays.
inline vec clamped(vec x, float low, float high) {
  x = x < all(low) ? all(low) : x;
  return x > all(high) ? all(high) : x;
}

// exp(x) for -80 <= x <= 0 to 2e-7: x = n log 2 + r, a polynomial for exp(r) (its coefficients interpolate at Chebyshev
// nodes, error 3e-9), and n added to the exponent's bits.
inline vec exponential(vec x) {
  vec n = nearest(x * 1.44269504f);
  vec r = x - n * 0.693359375f;  // log 2 in two parts, of which the first has few bits: the product is exact
  r = r + n * 2.12194440e-4f;
  vec p = r * 1.3948700519e-3f + 8.3752127029e-3f;
  p = p * r + 4.1666216475e-2f;
  p = p * r + 1.6666414470e-1f;
  p = p * r + 5.0000001084e-1f;
  p = p * r + 1.0f;
  p = p * r + 1.0f;
  return (vec)((ivec)p + (__builtin_convertvector(n, ivec) << 23));
}

// cos(2 pi r) and sin(2 pi r) for |r| <= 1/2 to 2e-7: polynomials in r^2, as above (errors 1e-8 and 2e-9).
inline vec cosine_of_reduced(vec r) {
  vec u = r * r;
  vec p = u * 6.5286581576f - 25.967599246f;
  p = p * u + 60.167630950f;
  p = p * u - 85.450139531f;
  p = p * u + 64.939117460f;
  p = p * u - 19.739204499f;
  return p * u + 0.99999998906f;
}

inline vec sine_of_reduced(vec r) {
  vec u = r * r;
  vec p = u * 3.2381374985f - 14.899846659f;
  p = p * u + 42.025926983f;
  p = p * u - 76.703015353f;
  p = p * u + 81.605131386f;
  p = p * u - 41.341700405f;
  p = p * u + 6.2831853025f;
  return p * r;
}

inline vec cosine_of_turns(vec turns) { return cosine_of_reduced(turns - nearest(turns)); }

// An angle in radians as a part of a turn in [-1/2, 1/2], with 2 pi in two parts so that large angles keep their digits.
inline vec reduced(vec angle) {
  vec n = nearest(angle * 0.159154943f);
  vec r = angle - n * 6.28125f;
  return (r - n * 1.9353072e-3f) * 0.159154943f;
}

// Kernels with unit variance from c r^2, by the names of gp/kernels.py, which has their formulas; `correlation_` there
// says what the range is for. A new one is a struct here and its place in KERNEL_TYPES.
struct RBF {
  static constexpr const char *name = "rbf";
  static inline vec correlation(vec argument) { return exponential(clamped(argument, -60.0f, 0.0f)); }
};

// s = sqrt(2 nu) r of a Matern kernel.
inline vec distance(vec argument) { return square_root(clamped(argument, 0.0f, 3600.0f)); }

struct Matern12 {
  static constexpr const char *name = "matern12";
  static inline vec correlation(vec argument) { return exponential(-distance(argument)); }
};

struct Matern32 {
  static constexpr const char *name = "matern32";
  static inline vec correlation(vec argument) {
    const vec s = distance(argument), decay = exponential(-s);
    return s * decay + decay;
  }
};

struct Matern52 {
  static constexpr const char *name = "matern52";
  static inline vec correlation(vec argument) {
    const vec s = distance(argument);
    return (s * s * (1.0f / 3.0f) + s + 1.0f) * exponential(-s);
  }
};

struct Matern72 {
  static constexpr const char *name = "matern72";
  static inline vec correlation(vec argument) {
    const vec s = distance(argument);
    return (((s * (1.0f / 15.0f) + 0.4f) * s + 1.0f) * s + 1.0f) * exponential(-s);
  }
};

#define KERNEL_TYPES RBF, Matern72, Matern52, Matern32, Matern12

// One block of UNITS columns of the first product, for POINTS points: values = base + x . weights.
inline void first_product(const vec *x, const float *weights, int64_t inputs, vec (&values)[UNITS][VECTORS]) {
  for (int64_t d = 0; d < inputs; d++, weights += UNITS)
#pragma GCC unroll 8
    for (int j = 0; j < UNITS; j++)
#pragma GCC unroll 2
      for (int v = 0; v < VECTORS; v++) values[j][v] += x[d * VECTORS + v] * weights[j];
}

// One block of UNITS rows of the second product, added to the outputs of POINTS points.
inline void second_product(
    const vec (&values)[UNITS][VECTORS], const float *weights, int64_t stride, int64_t outputs, vec *out) {
  for (int64_t o = 0; o < outputs; o++, weights += stride)
#pragma GCC unroll 2
    for (int v = 0; v < VECTORS; v++) {
      vec sum = out[o * VECTORS + v];
#pragma GCC unroll 8
      for (int j = 0; j < UNITS; j++) sum += values[j][v] * weights[j];
      out[o * VECTORS + v] = sum;
    }
}

// out [O, VECTORS] of POINTS points, whose inputs over the lengthscales are x [D, VECTORS].
template <class Kernel>
void evaluate(const Task &task, const Layer &layer, const float *kernel_out, const float *feature_out, const vec *x,
              vec *out) {
  const int64_t inputs = task.input_size;
  vec square[VECTORS] = {};
  for (int64_t d = 0; d < inputs; d++)
    for (int v = 0; v < VECTORS; v++) square[v] += x[d * VECTORS + v] * x[d * VECTORS + v];
  for (int v = 0; v < VECTORS; v++) square[v] *= layer.argument_scale;
  for (int64_t i = 0; i < layer.outputs * VECTORS; i++) out[i] = vec{};

  vec values[UNITS][VECTORS];
  for (int64_t m = 0; m < task.num_inducing; m += UNITS) {
    for (int j = 0; j < UNITS; j++)
      for (int v = 0; v < VECTORS; v++) values[j][v] = square[v] + layer.offsets[m + j];
    first_product(x, layer.centres + m * inputs, inputs, values);
    for (int j = 0; j < UNITS; j++)
      for (int v = 0; v < VECTORS; v++) values[j][v] = Kernel::correlation(values[j][v]);
    second_product(values, kernel_out + m, task.num_inducing, layer.outputs, out);
  }
  for (int64_t f = 0; f < task.num_features; f += UNITS) {
    for (int j = 0; j < UNITS; j++)
      for (int v = 0; v < VECTORS; v++) values[j][v] = all(layer.phases[f + j]);
    first_product(x, layer.frequencies + f * inputs, inputs, values);
    for (int j = 0; j < UNITS; j++)
      for (int v = 0; v < VECTORS; v++) values[j][v] = cosine_of_turns(values[j][v]);
    second_product(values, feature_out + f, task.num_features, layer.outputs, out);
  }
}

// Added to the outputs: the linear part, of the inputs over the lengthscales.
void add_linear(const float *weights, int64_t inputs, int64_t outputs, const vec *x, vec *out) {
  for (int64_t o = 0; o < outputs; o++, weights += inputs)
    for (int64_t d = 0; d < inputs; d++)
      for (int v = 0; v < VECTORS; v++) out[o * VECTORS + v] += x[d * VECTORS + v] * weights[d];
}

// The kernels by their numbers. Each layer has its own, so `evaluate` is called through a pointer: once for some ten
// thousand numbers between the two products, which is nothing.
struct Entry {
  const char *name;
  decltype(&evaluate<RBF>) evaluate;
};

template <class... Kernels>
struct Table {
  static constexpr Entry entries[] = {{Kernels::name, evaluate<Kernels>}...};
  static constexpr int64_t size = sizeof...(Kernels);
};

using KERNELS = Table<KERNEL_TYPES>;

// The part of a vector (heading, x, y) forwards, or to the left, of the body.
inline vec along_body(const int64_t *vector, const vec *state, int v, bool forwards) {
  const vec turn = reduced(state[vector[0] * VECTORS + v]);
  const vec cosine = cosine_of_reduced(turn), sine = sine_of_reduced(turn);
  const vec x = state[vector[1] * VECTORS + v], y = state[vector[2] * VECTORS + v];
  return forwards ? cosine * x + sine * y : cosine * y - sine * x;
}

// The standardised inputs [D, VECTORS] of POINTS points from their states [S, VECTORS] and actions.
void encode(const Task &task, const vec *state, const float *actions, int64_t count, vec *input) {
  for (int64_t d = 0; d < task.input_size; d++) {
    const int64_t kind = task.input_kind[d], source = task.input_source[d];
    for (int v = 0; v < VECTORS; v++) {
      vec raw = {};
      if (kind == 3) {
        for (int i = 0; i < LANES && v * LANES + i < count; i++)
          raw[i] = actions[(v * LANES + i) * task.horizon * task.action_size + source];
      } else {
        raw = kind > 3 ? along_body(task.vectors + 3 * source, state, v, kind == 4) : state[source * VECTORS + v];
        if (kind == 1) raw = sine_of_reduced(reduced(raw));
        if (kind == 2) raw = cosine_of_reduced(reduced(raw));
      }
      input[d * VECTORS + v] = (raw - task.input_mean[d]) * task.input_scale[d];
    }
  }
}

// The base and what the outputs add to it in dimension i of the state, its shift included.
inline vec with_added(const Task &task, const vec *out, int64_t i, int v, vec base) {
  base += task.shift[i];
  return task.target[i] < 0 ? base : base + out[task.target[i] * VECTORS + v] * task.spread[i];
}

// The next state [S, VECTORS], in place; `moved` [num_vectors, 2, VECTORS] is scratch.
void decode(const Task &task, const vec *out, vec *state, vec *moved) {
  // What is added to a vector turns by the heading before the step, so it is added while that is still in the state.
  for (int64_t k = 0; k < task.num_vectors; k++) {
    const int64_t *vector = task.vectors + 3 * k;
    for (int v = 0; v < VECTORS; v++) {
      const vec turn = reduced(state[vector[0] * VECTORS + v]);
      const vec cosine = cosine_of_reduced(turn), sine = sine_of_reduced(turn);
      const vec forwards = with_added(task, out, vector[1], v, vec{}), left = with_added(task, out, vector[2], v, vec{});
      const vec x = state[vector[1] * VECTORS + v] * task.carried[vector[1]];
      const vec y = state[vector[2] * VECTORS + v] * task.carried[vector[2]];
      moved[2 * k * VECTORS + v] = x + (cosine * forwards - sine * left);
      moved[(2 * k + 1) * VECTORS + v] = y + (sine * forwards + cosine * left);
    }
  }
  for (int64_t i = 0; i < task.observation_size; i++)
    for (int v = 0; v < VECTORS; v++) {
      vec &s = state[i * VECTORS + v];
      s = with_added(task, out, i, v, s * task.carried[i]);
    }
  for (int64_t k = 0; k < task.num_vectors; k++)
    for (int part = 0; part < 2; part++)
      for (int v = 0; v < VECTORS; v++)
        state[task.vectors[3 * k + 1 + part] * VECTORS + v] = moved[(2 * k + part) * VECTORS + v];
}

// Transpose the first `count` of POINTS states from [S, VECTORS] to rows of S.
void store(const vec *state, int64_t size, int64_t count, float *rows) {
  const float *lanes = (const float *)state;
  for (int64_t i = 0; i < count; i++)
    for (int64_t s = 0; s < size; s++) rows[i * size + s] = lanes[s * POINTS + i];
}

// The layer as one particle has it.
inline Layer of_particle(const Task &task, Layer layer, int64_t particle) {
  layer.inverse_lengthscale += particle * task.input_size;
  layer.centres += particle * task.num_inducing * task.input_size;
  layer.offsets += particle * task.num_inducing;
  layer.frequencies += particle * task.num_features * task.input_size;
  layer.phases += particle * task.num_features;
  return layer;
}

void run(const Task &task, int64_t particle, int64_t first, int64_t last, vec *scratch) {
  const int64_t size = task.observation_size, inputs = task.input_size;
  const int64_t blocks = (last - first + POINTS - 1) / POINTS;
  vec *states = scratch;                                      // [blocks, S, VECTORS]
  vec *input = states + blocks * size * VECTORS;              // [D, VECTORS]
  vec *scaled = input + inputs * VECTORS;                     // [D, VECTORS]
  vec *moved = scaled + inputs * VECTORS;                     // [num_vectors, 2, VECTORS]
  vec *out = moved + 2 * task.num_vectors * VECTORS;          // [max(D, S), VECTORS]
  const int64_t row = task.num_particles * task.num_candidates * size;
  for (int64_t b = 0; b < blocks; b++) {
    for (int64_t s = 0; s < size; s++)
      for (int v = 0; v < VECTORS; v++) states[(b * size + s) * VECTORS + v] = all(task.start[particle * size + s]);
  }
  for (int64_t step = 0; step <= task.horizon; step++) {
    // Steps outside, blocks inside: a step's functions are read once, and stay in the cache for all blocks.
    for (int64_t b = 0; b < blocks; b++) {
      const int64_t point = first + b * POINTS;
      const int64_t count = last - point < POINTS ? last - point : POINTS;
      vec *state = states + b * size * VECTORS;
      store(state, size, count, task.states + step * row + (particle * task.num_candidates + point) * size);
      if (step == task.horizon) continue;
      if (task.stretch && step > 0)
        for (int64_t s = 0; s < size; s++)
          for (int v = 0; v < VECTORS; v++)
            state[s * VECTORS + v] += (state[s * VECTORS + v] - task.centre[s]) * task.stretch[s];
      const int64_t function = (task.num_functions == 1 ? 0 : step) * task.num_particles + particle;
      encode(task, state, task.actions + (point * task.horizon + step) * task.action_size, count, input);
      for (int64_t l = 0; l < task.num_layers; l++) {
        const Layer layer = of_particle(task, task.layers[l], particle);
        for (int64_t d = 0; d < inputs; d++)
          for (int v = 0; v < VECTORS; v++)
            scaled[d * VECTORS + v] = input[d * VECTORS + v] * layer.inverse_lengthscale[d];
        KERNELS::entries[layer.kernel].evaluate(
            task, layer, layer.kernel_out + function * layer.outputs * task.num_inducing,
            layer.feature_out + function * layer.outputs * task.num_features, scaled, out);
        if (layer.linear_out)
          add_linear(layer.linear_out + function * layer.outputs * inputs, inputs, layer.outputs, scaled, out);
        if (l + 1 < task.num_layers)
          for (int64_t i = 0; i < inputs * VECTORS; i++) input[i] += out[i];
      }
      const int64_t outputs = task.layers[task.num_layers - 1].outputs;
      if (task.noise) {
        const float *noise = task.noise + (step * task.num_particles + particle) * outputs;
        for (int64_t o = 0; o < outputs; o++)
          for (int v = 0; v < VECTORS; v++) out[o * VECTORS + v] += noise[o];
      }
      for (int64_t o = 0; o < outputs; o++)
        for (int v = 0; v < VECTORS; v++)
          out[o * VECTORS + v] = clamped(out[o * VECTORS + v], task.lowest[o], task.highest[o]);
      decode(task, out, state, moved);
    }
  }
}

}  // namespace

extern "C" {

// What the caller needs to know of this build.
int64_t units() { return UNITS; }
int64_t points() { return POINTS; }

// The number by which a Layer names this kernel; -1 if it is not here.
int64_t kernel_number(const char *name) {
  for (int64_t i = 0; i < KERNELS::size; i++)
    if (!strcmp(KERNELS::entries[i].name, name)) return i;
  return -1;
}

// Roll out the candidates first..last-1 of one particle. Returns 0, or 1 if there was no memory.
int64_t rollout(const Task *task, int64_t particle, int64_t first, int64_t last) {
  const int64_t blocks = (last - first + POINTS - 1) / POINTS;
  const int64_t widest = task->input_size > task->observation_size ? task->input_size : task->observation_size;
  const int64_t rows = blocks * task->observation_size + 2 * task->input_size + 2 * task->num_vectors + widest;
  void *memory = nullptr;
  if (posix_memalign(&memory, sizeof(vec), rows * VECTORS * sizeof(vec))) return 1;
  vec *scratch = (vec *)memory;
  run(*task, particle, first, last, scratch);
  free(memory);
  return 0;
}
}
