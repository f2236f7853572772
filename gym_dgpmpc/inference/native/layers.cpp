// One layer of C chains as training needs it, in double precision: kernel matrices, their products, and gradients.
//
// `inference/compiled_layers.py` calls this; `inference/layers.py` has the same formulas in PyTorch, and says what they
// are. Per chain there are M inducing inputs and n points of D numbers, and O outputs. A call takes the chains
// first..last-1, which do not meet; several threads may call at the same time. Points are taken POINTS at a time, so
// that what lies between two products stays in the cache, and a product with a triangular matrix leaves the zeros out.
//
// Large matrices have rows of whole vectors and whole blocks of rows, here and at the caller: [n', M'] and [M', M'],
// with n' and M' as `padded` says. What stands beyond n and M is finite. Built on the user's machine with its own vector
// width (GCC or Clang; see `compiler.py`). NaN goes through.

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <initializer_list>

#if defined(__AVX512F__)
#include <immintrin.h>
#define LANES 8
#define ROWS 8
#elif defined(__AVX2__)
#include <immintrin.h>
#define LANES 4
#define ROWS 4
#else
#define LANES 2
#define ROWS 4
#endif
#define VECTORS 3
#define POINTS 64

typedef double vec __attribute__((vector_size(8 * LANES), may_alias));
typedef int64_t ivec __attribute__((vector_size(8 * LANES), may_alias));

extern "C" {

// Of C chains, one after the other.
struct Layer {
  int64_t kernel;                    // see `kernel_number`
  int64_t num_inducing, input_size;  // M, D
  const double *lengthscale;         // [C, D]
  const double *variance;            // [C]
  const double *centres;             // [C, M, D], over the lengthscales
  const double *linear;              // [C, D], variances of the slopes of a linear part, or null
  const double *own_slope;           // [C, M', M'], from `own_correlations`
  const double *inverse;             // [C, 2, M', M'], from `invert`: lower triangular, and its transpose
};
}

namespace {

inline vec all(double value) { return vec{} + value; }
inline int64_t rounded_up(int64_t size, int64_t unit) { return (size + unit - 1) / unit * unit; }
inline int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }
inline int64_t larger(int64_t a, int64_t b) { return a > b ? a : b; }
inline int64_t padded(int64_t size) { return rounded_up(size, ROWS); }
inline vec &at(double *values) { return *(vec *)values; }
inline const vec &at(const double *values) { return *(const vec *)values; }

#if defined(__AVX512F__)
inline vec square_root(vec x) { return (vec)_mm512_sqrt_pd((__m512d)x); }
#elif defined(__AVX2__)
inline vec square_root(vec x) { return (vec)_mm256_sqrt_pd((__m256d)x); }
#else
inline vec square_root(vec x) {
  for (int i = 0; i < LANES; i++) x[i] = sqrt(x[i]);
  return x;
}
#endif

// exp(-x) for 0 <= x <= FARTHEST to 2e-16: -x = n log 2 + r, a polynomial for exp(r) (its coefficients interpolate at
// Chebyshev nodes, error 2e-17), times 2^n. Adding 1.5 * 2^52 rounds to a whole number, which is then in the low bits.
constexpr double FARTHEST = 300.0;  // so that products of two values are no subnormals, which are slow

inline vec decay_of(vec x) {
  const vec shifted = 6755399441055744.0 - x * 1.4426950408889634;
  const vec n = shifted - 6755399441055744.0;
  const vec r = -x - n * 0.6931471803691238 - n * 1.9082149292705877e-10;  // the first part of log 2 has few bits
  vec p = r * 2.5110037605963777712e-8 + 2.7632639639041029749e-7;
  p = p * r + 2.7557240918578969823e-6;
  p = p * r + 2.4801485482328492419e-5;
  p = p * r + 1.9841269890047113707e-4;
  p = p * r + 1.3888888952314774652e-3;
  p = p * r + 8.3333333333196006109e-3;
  p = p * r + 4.1666666666488095495e-2;
  p = p * r + 1.6666666666666680806e-1;
  p = p * r + 5.0000000000000183855e-1;
  p = p * r + 1.0;
  p = p * r + 1.0;
  return p * (vec)(((ivec)shifted << 52) + (int64_t(1023) << 52));
}

// Kernels with unit variance and their slopes by r^2, by the names of gp/kernels.py, which has their formulas. A new
// one is a struct here and its place in KERNEL_TYPES.
struct Pair {
  vec value, slope;
};

struct RBF {
  static constexpr const char *name = "rbf";
  static inline Pair of(vec sqdist) {
    const vec half = 0.5 * sqdist, value = decay_of(half > FARTHEST ? all(FARTHEST) : half);
    return {value, -0.5 * value};
  }
};

// s = sqrt(2 nu) r of a Matern kernel.
inline vec distance(vec sqdist, double degrees) {
  const vec s = square_root(degrees * sqdist);
  return s > FARTHEST ? all(FARTHEST) : s;
}

struct Matern12 {
  static constexpr const char *name = "matern12";
  static inline Pair of(vec sqdist) {
    const vec s = distance(sqdist, 1.0), decay = decay_of(s);
    return {decay, -0.5 * decay / (s < 1e-6 ? all(1e-6) : s)};
  }
};

struct Matern32 {
  static constexpr const char *name = "matern32";
  static inline Pair of(vec sqdist) {
    const vec s = distance(sqdist, 3.0), decay = decay_of(s);
    return {s * decay + decay, -1.5 * decay};
  }
};

struct Matern52 {
  static constexpr const char *name = "matern52";
  static inline Pair of(vec sqdist) {
    const vec s = distance(sqdist, 5.0), decay = decay_of(s);
    return {(s * s * (1.0 / 3.0) + s + 1.0) * decay, (s * decay + decay) * (-5.0 / 6.0)};
  }
};

struct Matern72 {
  static constexpr const char *name = "matern72";
  static inline Pair of(vec sqdist) {
    const vec s = distance(sqdist, 7.0), decay = decay_of(s), quadratic = s * s * (1.0 / 3.0) + s + 1.0;
    return {(s * s * ((s + 1.0) * (1.0 / 15.0)) + quadratic) * decay, quadratic * decay * -0.7};
  }
};

#define KERNEL_TYPES RBF, Matern72, Matern52, Matern32, Matern12

// Squared distances to values in place, and to slopes.
template <class Kernel>
void evaluate(double *values, double *slopes, int64_t count) {
  for (int64_t i = 0; i < count; i += LANES) {
    const vec sqdist = at(values + i);
    // Below this two points are one; NaN stays.
    const Pair found = Kernel::of(sqdist <= 1e-12 ? vec{} : sqdist);
    at(values + i) = found.value;
    at(slopes + i) = found.slope;
  }
}

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

// A matrix, or with its strides exchanged the transpose of one, of which single numbers are read.
struct View {
  const double *values;
  int64_t row, column;
};

// A matrix whose rows are whole vectors.
struct Matrix {
  double *values;
  int64_t width;
  double *row(int64_t i) const { return values + i * width; }
  View view() const { return {values, width, 1}; }
  View transposed() const { return {values, 1, width}; }
};

struct Range {
  int64_t begin, end;
};

// c += a b, or c = a b if not ADD, for ROWS rows and some vectors of columns, which stay in registers. Each vector has
// the k of its own that count; they share those from the latest beginning to the earliest end.
template <bool ADD, int COUNT>
inline void tile(View a, Matrix b, Matrix c, int64_t i, int64_t j, const Range *ranges) {
  vec sum[ROWS][COUNT];
#pragma GCC unroll 8
  for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 3
    for (int v = 0; v < COUNT; v++) sum[r][v] = ADD ? at(c.row(i + r) + j + v * LANES) : vec{};
  Range shared = ranges[0];
#pragma GCC unroll 3
  for (int v = 1; v < COUNT; v++)
    shared = {larger(shared.begin, ranges[v].begin), smaller(shared.end, ranges[v].end)};
  if (shared.end < shared.begin) shared.end = shared.begin;
#pragma GCC unroll 3
  for (int v = 0; v < COUNT; v++) {
    const Range range = ranges[v];
    const Range parts[2] = {{range.begin, smaller(shared.begin, range.end)}, {larger(shared.end, range.begin), range.end}};
#pragma GCC unroll 2
    for (const Range part : parts) {
      const double *left = a.values + i * a.row + part.begin * a.column;
      for (int64_t k = part.begin; k < part.end; k++, left += a.column) {
        const vec right = at(b.row(k) + j + v * LANES);
#pragma GCC unroll 8
        for (int r = 0; r < ROWS; r++) sum[r][v] += left[r * a.row] * right;
      }
    }
  }
  const double *left = a.values + i * a.row + shared.begin * a.column;
  for (int64_t k = shared.begin; k < shared.end; k++, left += a.column) {
    vec right[COUNT];
#pragma GCC unroll 3
    for (int v = 0; v < COUNT; v++) right[v] = at(b.row(k) + j + v * LANES);
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 3
      for (int v = 0; v < COUNT; v++) sum[r][v] += left[r * a.row] * right[v];
  }
#pragma GCC unroll 8
  for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 3
    for (int v = 0; v < COUNT; v++) at(c.row(i + r) + j + v * LANES) = sum[r][v];
}

// The product for rows first..last-1 and all columns of c; `ranges(i, j)` says which k count for ROWS rows from i and a
// vector of columns from j on. Columns are outside: theirs of b stay in the nearest cache.
template <bool ADD = true, class Ranges>
void product(View a, Matrix b, Matrix c, int64_t first, int64_t last, Ranges ranges) {
  for (int64_t j = 0; j < c.width; j += VECTORS * LANES)
    for (int64_t i = first; i < last; i += ROWS) {
      Range each[VECTORS];
      int count = 0;  // without the last vectors for which no k counts
      for (int v = 0; v < VECTORS && j + v * LANES < c.width; v++) {
        each[v] = ranges(i, j + v * LANES);
        if (each[v].begin < each[v].end) count = v + 1;
      }
      if (count == 3)
        tile<ADD, 3>(a, b, c, i, j, each);
      else if (count == 2)
        tile<ADD, 2>(a, b, c, i, j, each);
      else if (count == 1)
        tile<ADD, 1>(a, b, c, i, j, each);
    }
}

inline Range every(int64_t count) { return {0, count}; }

// One of the caller's large matrices, of which there are some one after the other.
inline Matrix given(const double *values, int64_t rows, int64_t columns, int64_t index) {
  return {const_cast<double *>(values) + index * padded(rows) * padded(columns), padded(columns)};
}

void clear(Matrix m, int64_t rows) { memset(m.values, 0, rows * m.width * sizeof(double)); }

// Small rows of the caller, `size` numbers each, into padded ones; zeros behind each, and in the rows up to `rows`.
void read(Matrix to, const double *from, int64_t count, int64_t size, int64_t rows) {
  clear(to, rows);
  for (int64_t i = 0; i < count; i++)
    for (int64_t j = 0; j < size; j++) to.row(i)[j] = from[i * size + j];
}

// The same, transposed.
void read_transposed(Matrix to, const double *from, int64_t count, int64_t size) {
  clear(to, padded(size));
  for (int64_t i = 0; i < count; i++)
    for (int64_t j = 0; j < size; j++) to.row(j)[i] = from[i * size + j];
}

// Memory for one call, cut into matrices. A first pass without memory finds how much is needed.
class Memory {
 public:
  explicit Memory(double *begin = nullptr) : begin_(begin) {}
  Matrix matrix(int64_t rows, int64_t columns) {
    const Matrix taken = {begin_ + size_, padded(columns)};
    size_ += padded(rows) * taken.width;
    return taken;
  }
  int64_t size() const { return size_; }

 private:
  double *begin_;
  int64_t size_ = 0;
};

// Calls `body(Buffers)` with memory for it. Returns 0, or 1 if there was none.
template <class Buffers, class Body>
int64_t with_memory(const Layer &layer, int64_t outputs, Body body) {
  Memory needed;
  Buffers(needed, layer, outputs);
  void *memory = nullptr;
  if (posix_memalign(&memory, 64, needed.size() * sizeof(double))) return 1;
  Memory taken((double *)memory);
  body(Buffers(taken, layer, outputs));
  free(memory);
  return 0;
}

// What one chain has of a layer.
struct Own {
  int64_t size, inputs;  // M, D
  const double *lengthscale, *centres, *linear;
  double variance;
  Matrix slope, inverse, transposed;
  Own(const Layer &layer, int64_t chain)
      : size(layer.num_inducing),
        inputs(layer.input_size),
        lengthscale(layer.lengthscale + chain * inputs),
        centres(layer.centres + chain * size * inputs),
        linear(layer.linear ? layer.linear + chain * inputs : nullptr),
        variance(layer.variance[chain]),
        slope(given(layer.own_slope, size, size, chain)),
        inverse(given(layer.inverse, size, size, 2 * chain)),
        transposed(given(layer.inverse, size, size, 2 * chain + 1)) {}
};

// Correlations, and their slopes, between points and the inducing inputs.
struct CorrelationBuffers {
  Matrix centres, lengths, points, squares;
  CorrelationBuffers(Memory &memory, const Layer &layer, int64_t num_points)
      : centres(memory.matrix(layer.input_size, layer.num_inducing)),
        lengths(memory.matrix(1, layer.num_inducing)),
        points(memory.matrix(num_points, layer.input_size)),
        squares(memory.matrix(1, num_points)) {}
};

// The centres, transposed, and the squares of their lengths.
void read_centres(const Own &own, const CorrelationBuffers &use) {
  read_transposed(use.centres, own.centres, own.size, own.inputs);
  clear(use.lengths, 1);
  for (int64_t d = 0; d < own.inputs; d++)
    for (int64_t j = 0; j < use.centres.width; j += LANES)
      at(use.lengths.values + j) += at(use.centres.row(d) + j) * at(use.centres.row(d) + j);
}

// Of some points, over the lengthscales; r^2 = |x|^2 + |z|^2 - 2 x.z. A linear part is added to the values.
void correlate(const Layer &layer, const Own &own, const double *scaled, int64_t count, Matrix values, double *slopes,
               const CorrelationBuffers &use) {
  const int64_t rows = padded(count), inputs = own.inputs;
  read(use.points, scaled, count, inputs, rows);
  for (int64_t i = 0; i < rows; i++) {
    double square = 0.0;
    for (int64_t d = 0; d < inputs; d++) {
      square += use.points.row(i)[d] * use.points.row(i)[d];
      use.points.row(i)[d] *= -2.0;
    }
    square += square - square;  // NaN if infinite: such a point is none, rather than one that is far
    for (int64_t j = 0; j < values.width; j += LANES) at(values.row(i) + j) = square + at(use.lengths.values + j);
  }
  product(use.points.view(), use.centres, values, 0, rows, [=](int64_t, int64_t) { return every(inputs); });
  KERNELS::entries[layer.kernel].evaluate(values.values, slopes, rows * values.width);
  if (!own.linear) return;
  for (int64_t i = 0; i < rows; i++)
    for (int64_t d = 0; d < inputs; d++) use.points.row(i)[d] *= -0.5 * own.linear[d];
  product(use.points.view(), use.centres, values, 0, rows, [=](int64_t, int64_t) { return every(inputs); });
}

// Upper triangular U = L^T with U^T U = m + jitter, row by row of blocks: what the rows above say of a block of rows,
// then these one after the other. Returns whether it exists.
bool factorise_one(int64_t size, const double *m, int64_t row_of_m, double jitter, Matrix upper) {
  clear(upper, padded(size));
  bool exists = true;
  for (int64_t first = 0; first < size; first += ROWS) {
    const int64_t end = smaller(first + ROWS, size);
    for (int64_t i = first; i < end; i++) {
      for (int64_t j = i; j < size; j++) upper.row(i)[j] = -m[i * row_of_m + j];
      upper.row(i)[i] -= jitter;
    }
    product(upper.transposed(), upper, upper, first, first + ROWS,
            [=](int64_t, int64_t j) { return j + LANES > first ? every(first) : Range{0, 0}; });
    for (int64_t i = first; i < end; i++) {
      double *row = upper.row(i);
      for (int64_t k = first; k < i; k++)
        for (int64_t j = first; j < upper.width; j += LANES) at(row + j) += upper.row(k)[i] * at(upper.row(k) + j);
      const double pivot = sqrt(-row[i]), scale = -1.0 / pivot;
      exists = exists && pivot > 0.0 && pivot < HUGE_VAL;
      for (int64_t j = first; j < upper.width; j += LANES) at(row + j) *= scale;
      for (int64_t j = first; j < i; j++) row[j] = 0.0;
    }
    // Of columns before the block, and beyond the last, nothing is said.
    for (int64_t i = first; i < first + ROWS; i++) {
      memset(upper.row(i), 0, (i < end ? first : upper.width) * sizeof(double));
      if (i < end) memset(upper.row(i) + size, 0, (upper.width - size) * sizeof(double));
    }
  }
  return exists;
}

// L^-1 by forward substitution: what the rows above say of a block of rows, then these one after the other.
void invert_chain(int64_t size, Matrix upper, Matrix inverse, Matrix transposed) {
  const int64_t rows = padded(size);
  clear(inverse, rows);
  for (int64_t first = 0; first < size; first += ROWS) {
    product(upper.transposed(), inverse, inverse, first, first + ROWS,
            [=](int64_t, int64_t j) { return Range{j, first}; });
    for (int64_t i = first; i < smaller(first + ROWS, size); i++) {
      double *row = inverse.row(i);
      for (int64_t k = first; k < i; k++)
        for (int64_t j = 0; j < first + ROWS; j += LANES) at(row + j) += upper.row(k)[i] * at(inverse.row(k) + j);
      row[i] -= 1.0;
      const double scale = -1.0 / upper.row(i)[i];
      for (int64_t j = 0; j < first + ROWS; j += LANES) at(row + j) *= scale;
    }
  }
  for (int64_t i = 0; i < rows; i += ROWS)
    for (int64_t j = 0; j < rows; j += ROWS)
      for (int64_t k = i; k < i + ROWS; k++)
        for (int64_t l = j; l < j + ROWS; l++) transposed.row(l)[k] = inverse.row(k)[l];
}

struct SeeBuffers {
  CorrelationBuffers correlations;
  Matrix values;
  SeeBuffers(Memory &memory, const Layer &layer, int64_t)
      : correlations(memory, layer, POINTS), values(memory.matrix(POINTS, layer.num_inducing)) {}
};

void see_chain(const Layer &layer, const Own &own, const double *x, int64_t num_points, double *scaled,
               Matrix projected, Matrix slope, const SeeBuffers &use) {
  const int64_t size = own.size, inputs = own.inputs;
  read_centres(own, use.correlations);
  for (int64_t i = 0; i < num_points; i++)
    for (int64_t d = 0; d < inputs; d++) scaled[i * inputs + d] = x[i * inputs + d] / own.lengthscale[d];
  for (int64_t p = 0; p < num_points; p += POINTS) {
    const int64_t count = smaller(num_points - p, POINTS);
    correlate(layer, own, scaled + p * inputs, count, use.values, slope.row(p), use.correlations);
    product<false>(use.values.view(), own.transposed, {projected.row(p), projected.width}, 0, padded(count),
                   [=](int64_t, int64_t j) { return every(smaller(j + LANES, size)); });
  }
}

struct MomentBuffers {
  Matrix whitened, mean;
  MomentBuffers(Memory &memory, const Layer &layer, int64_t outputs)
      : whitened(memory.matrix(layer.num_inducing, outputs)), mean(memory.matrix(POINTS, outputs)) {}
};

// k(x, x) over the variance.
inline double own_variance(const Own &own, const double *scaled) {
  double sum = 1.0;
  for (int64_t d = 0; own.linear && d < own.inputs; d++) sum += own.linear[d] * scaled[d] * scaled[d];
  return sum;
}

void moments_chain(const Own &own, int64_t outputs, const double *whitened, int64_t num_points, const double *scaled,
                   Matrix projected, double least, double *mean, double *variance, const MomentBuffers &use) {
  const int64_t size = own.size;
  const double deviation = sqrt(own.variance);
  read(use.whitened, whitened, size, outputs, padded(size));
  for (int64_t i = 0; i < size * use.whitened.width; i += LANES) at(use.whitened.values + i) *= deviation;
  for (int64_t p = 0; p < num_points; p += POINTS) {
    const int64_t count = smaller(num_points - p, POINTS);
    product<false>({projected.row(p), projected.width, 1}, use.whitened, use.mean, 0, padded(count),
                   [=](int64_t, int64_t) { return every(size); });
    for (int64_t i = 0; i < count; i++) {
      for (int64_t o = 0; o < outputs; o++) mean[(p + i) * outputs + o] = use.mean.row(i)[o];
      vec sum = {};
      for (int64_t j = 0; j < projected.width; j += LANES)
        sum += at(projected.row(p + i) + j) * at(projected.row(p + i) + j);
      double known = 0.0;
      for (int j = 0; j < LANES; j++) known += sum[j];
      const double left = own.variance * (own_variance(own, scaled + (p + i) * own.inputs) - known);
      variance[p + i] = left < least ? least : left;
    }
  }
}

// Lower triangle of m += left^T right over `rows` rows, by whole blocks.
void add_lower(Matrix left, Matrix right, int64_t rows, Matrix m, int64_t size) {
  product(left.transposed(), right, m, 0, padded(size),
          [=](int64_t i, int64_t j) { return i + ROWS > j ? every(rows) : Range{0, 0}; });
}

struct Points {
  int64_t count, outputs;      // n, O
  const double *whitened;      // [C, M, O]
  const double *scaled;        // [C, n, D]
  const double *projected;     // [C, n', M']
  const double *slope;         // [C, n', M']
  const double *mean;          // [C, n, O]
  const double *variance;      // [C, n]
  const double *mean_bar;      // [C, n, O]
  const double *variance_bar;  // [C, n]
  double *whitened_bar;        // [C, M, O]
  double *points_bar;          // [C, n, D], or null
  double *inducing_bar;        // [C, M, D], or null, and with it the next two
  double *log_lengthscale_bar; // [C, D]
  double *log_variance_bar;    // [C]
  double *log_slope_bar;       // [C, D], or null without a linear part
};

struct BackBuffers {
  Matrix centres, whitened, mean_bar, bar, by_distance, points, moved;
  Matrix whitened_bar, lower, left, both, own, by_centre, along, seen_from, seen_own;
  BackBuffers(Memory &memory, const Layer &layer, int64_t outputs)
      : centres(memory.matrix(layer.num_inducing, layer.input_size + 1)),
        whitened(memory.matrix(outputs, layer.num_inducing)),
        mean_bar(memory.matrix(POINTS, outputs)),
        bar(memory.matrix(POINTS, layer.num_inducing)),
        by_distance(memory.matrix(POINTS, layer.num_inducing)),
        points(memory.matrix(POINTS, layer.input_size + 1)),
        moved(memory.matrix(POINTS, layer.input_size + 1)),
        whitened_bar(memory.matrix(outputs, layer.num_inducing)),
        lower(memory.matrix(layer.num_inducing, layer.num_inducing)),
        left(memory.matrix(layer.num_inducing, layer.num_inducing)),
        both(memory.matrix(layer.num_inducing, layer.num_inducing)),
        own(memory.matrix(layer.num_inducing, layer.input_size + 1)),
        by_centre(memory.matrix(layer.input_size + 1, layer.num_inducing)),
        along(memory.matrix(POINTS, layer.input_size + 1)),
        seen_from(memory.matrix(layer.input_size + 1, layer.num_inducing)),
        seen_own(memory.matrix(layer.num_inducing, layer.input_size + 1)) {}
};

// Rows of the caller, with a last column of ones: with it the sums over a product's terms come with the product.
void read_with_ones(Matrix to, const double *from, int64_t count, int64_t size, int64_t rows) {
  read(to, from, count, size, rows);
  for (int64_t i = 0; i < count; i++) to.row(i)[size] = 1.0;
}

// Of the inducing inputs: through their distances to the points, and through the factor of their own correlations.
// Adds to the gradients of the logarithms of the lengthscales, and of the slopes' variances.
void inducing_gradient(const Own &own, const BackBuffers &use, int64_t outputs, double *inducing_bar,
                       double *log_lengthscale_bar, double *linear_bar) {
  const int64_t size = own.size, inputs = own.inputs, rows = padded(size);
  // `lower` has A_bar A^T so far as it comes from the variances; of the means it is a product of few columns.
  add_lower(use.whitened, use.whitened_bar, outputs, use.lower, size);
  for (int64_t i = 0; i < size; i++) {
    use.lower.row(i)[i] *= 0.5;
    memset(use.lower.row(i) + i + 1, 0, (use.lower.width - i - 1) * sizeof(double));
  }
  clear(use.left, rows);
  product(use.lower.view(), own.inverse, use.left, 0, rows,
          [=](int64_t i, int64_t j) { return Range{j, smaller(i + ROWS, size)}; });
  product<false>(own.inverse.transposed(), use.left, use.both, 0, rows,
                 [=](int64_t i, int64_t j) { return Range{larger(i, j), size}; });
  // The gradient of the correlations is minus half the sum of this and its transpose; that of the squared distances is it
  // times the slope, which is symmetric.
  const auto with_transpose = [&](Matrix half, Matrix out) {
    clear(out, rows);
    for (const View part : {half.view(), half.transposed()})
      product(part, use.centres, out, 0, rows, [=](int64_t, int64_t) { return every(size); });
  };
  if (own.linear) with_transpose(use.both, use.seen_own);
  for (int64_t i = 0; i < rows * use.both.width; i += LANES) at(use.both.values + i) *= at(own.slope.values + i);
  with_transpose(use.both, use.own);
  for (int64_t i = 0; i < size; i++)
    for (int64_t d = 0; d < inputs; d++) {
      const double centre = own.centres[i * inputs + d];
      const double by_points = use.by_centre.row(inputs)[i] * centre - use.by_centre.row(d)[i];
      const double by_centres = use.own.row(i)[inputs] * centre - use.own.row(i)[d];
      double bar = 2.0 * by_points - 2.0 * by_centres;
      if (own.linear) {
        const double from = use.seen_from.row(d)[i], by_own = -0.5 * use.seen_own.row(i)[d];
        bar += (from + 2.0 * by_own) * own.linear[d];
        linear_bar[d] += centre * (from + by_own);
      }
      log_lengthscale_bar[d] -= bar * centre;
      inducing_bar[i * inputs + d] = bar / own.lengthscale[d];
    }
}

void back_chain(const Layer &layer, const Points &points, int64_t chain, const BackBuffers &use) {
  const Own own(layer, chain);
  const int64_t size = own.size, inputs = own.inputs, outputs = points.outputs, num = points.count;
  const double deviation = sqrt(own.variance);
  const double *scaled = points.scaled + chain * num * inputs, *mean_bar = points.mean_bar + chain * num * outputs;
  const double *variance_bar = points.variance_bar + chain * num;
  const Matrix all_projected = given(points.projected, num, size, chain), slope = given(points.slope, num, size, chain);
  const bool of_parameters = points.inducing_bar, further = points.points_bar || of_parameters;
  double *log_lengthscale_bar = points.log_lengthscale_bar + (of_parameters ? chain * inputs : 0);
  double *linear_bar = points.log_slope_bar + (points.log_slope_bar ? chain * inputs : 0);
  for (int64_t d = 0; of_parameters && d < inputs; d++) log_lengthscale_bar[d] = 0.0;
  for (int64_t d = 0; points.log_slope_bar && d < inputs; d++) linear_bar[d] = 0.0;
  read_transposed(use.whitened, points.whitened + chain * size * outputs, size, outputs);
  read_with_ones(use.centres, own.centres, size, inputs, padded(size));
  clear(use.whitened_bar, padded(outputs));
  clear(use.lower, padded(size));
  clear(use.by_centre, padded(inputs + 1));
  clear(use.seen_from, padded(inputs + 1));
  for (int64_t p = 0; p < num; p += POINTS) {
    const int64_t count = smaller(num - p, POINTS), rows = padded(count);
    const auto all_points = [=](int64_t, int64_t) { return every(rows); };
    const Matrix projected = {all_projected.row(p), all_projected.width};
    read(use.mean_bar, mean_bar + p * outputs, count, outputs, rows);
    for (int64_t i = 0; i < rows * use.mean_bar.width; i += LANES) at(use.mean_bar.values + i) *= deviation;
    product(use.mean_bar.transposed(), projected, use.whitened_bar, 0, padded(outputs), all_points);
    if (!further) continue;
    // The gradient of A by the variances, ...
    for (int64_t i = 0; i < rows; i++) {
      const double weight = i < count ? -2.0 * own.variance * variance_bar[p + i] : 0.0;
      for (int64_t j = 0; j < use.bar.width; j += LANES) at(use.bar.row(i) + j) = weight * at(projected.row(i) + j);
    }
    if (of_parameters) add_lower(use.bar, projected, rows, use.lower, size);
    // ... and by the means; then of the correlations, and of the squared distances.
    product(use.mean_bar.view(), use.whitened, use.bar, 0, rows, [=](int64_t, int64_t) { return every(outputs); });
    product<false>(use.bar.view(), own.inverse, use.by_distance, 0, rows,
                   [=](int64_t, int64_t j) { return Range{j, size}; });
    if (of_parameters || own.linear) read_with_ones(use.points, scaled + p * inputs, count, inputs, rows);
    if (own.linear) {
      product<false>(use.by_distance.view(), use.centres, use.along, 0, rows,
                     [=](int64_t, int64_t) { return every(size); });
      product(use.points.transposed(), use.by_distance, use.seen_from, 0, padded(inputs), all_points);
    }
    for (int64_t i = 0; i < rows * slope.width; i += LANES)
      at(use.by_distance.values + i) *= at(slope.row(p) + i);
    product<false>(use.by_distance.view(), use.centres, use.moved, 0, rows,
                   [=](int64_t, int64_t) { return every(size); });
    for (int64_t i = 0; i < count; i++)
      for (int64_t d = 0; d < inputs; d++) {
        const int64_t n = (p + i) * inputs + d;
        double bar = 2.0 * (use.moved.row(i)[inputs] * scaled[n] - use.moved.row(i)[d]);
        if (own.linear) {
          const double by_own = own.variance * variance_bar[p + i];
          bar += (use.along.row(i)[d] + 2.0 * by_own * scaled[n]) * own.linear[d];
          if (points.log_slope_bar) linear_bar[d] += by_own * scaled[n] * scaled[n];
        }
        if (points.points_bar) points.points_bar[chain * num * inputs + n] = bar / own.lengthscale[d];
        if (of_parameters) log_lengthscale_bar[d] -= bar * scaled[n];
      }
    if (!of_parameters) continue;
    product(use.points.transposed(), use.by_distance, use.by_centre, 0, padded(inputs + 1), all_points);
  }
  double *whitened_bar = points.whitened_bar + chain * size * outputs;
  for (int64_t i = 0; i < size; i++)
    for (int64_t o = 0; o < outputs; o++) whitened_bar[i * outputs + o] = use.whitened_bar.row(o)[i];
  if (!of_parameters) return;
  inducing_gradient(own, use, outputs, points.inducing_bar + chain * size * inputs, log_lengthscale_bar, linear_bar);
  double by_means = 0.0, by_variances = 0.0;
  for (int64_t i = 0; i < num * outputs; i++) by_means += mean_bar[i] * points.mean[chain * num * outputs + i];
  for (int64_t i = 0; i < num; i++) by_variances += variance_bar[i] * points.variance[chain * num + i];
  points.log_variance_bar[chain] = 0.5 * by_means + by_variances;
  for (int64_t d = 0; points.log_slope_bar && d < inputs; d++) linear_bar[d] *= 2.0 * own.linear[d];
}

struct GramBuffers {
  Matrix weighted, sum;
  GramBuffers(Memory &memory, const Layer &layer, int64_t)
      : weighted(memory.matrix(POINTS, layer.num_inducing)),
        sum(memory.matrix(layer.num_inducing, layer.num_inducing)) {}
};

void gram_of(int64_t size, int64_t num_points, Matrix projected, const double *weights, double *out,
             const GramBuffers &use) {
  clear(use.sum, padded(size));
  for (int64_t p = 0; p < num_points; p += POINTS) {
    const int64_t count = smaller(num_points - p, POINTS), rows = padded(count);
    const Matrix block = {projected.row(p), projected.width};
    for (int64_t i = 0; i < rows; i++)
      for (int64_t j = 0; j < block.width; j += LANES)
        at(use.weighted.row(i) + j) = (i < count ? weights[p + i] : 0.0) * at(block.row(i) + j);
    add_lower(use.weighted, block, rows, use.sum, size);
  }
  for (int64_t i = 0; i < size; i++)
    for (int64_t j = 0; j <= i; j++) out[i * size + j] = out[j * size + i] = use.sum.row(i)[j];
}

}  // namespace

extern "C" {

// The number by which a Layer names this kernel; -1 if it is not here.
int64_t kernel_number(const char *name) {
  for (int64_t i = 0; i < KERNELS::size; i++)
    if (!strcmp(KERNELS::entries[i].name, name)) return i;
  return -1;
}

// What rows and columns of large matrices are whole multiples of.
int64_t unit() { return ROWS; }

// Correlations of the inducing inputs, and their slopes: [C, M', M']. Returns 0, or 1 if there was no memory.
int64_t own_correlations(const Layer *layer, double *value, double *slope, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing;
  return with_memory<CorrelationBuffers>(*layer, size, [&](const CorrelationBuffers &use) {
    for (int64_t c = first; c < last; c++) {
      const Own own(*layer, c);
      read_centres(own, use);
      correlate(*layer, own, own.centres, size, given(value, size, size, c), given(slope, size, size, c).values, use);
    }
  });
}

// Upper triangular factors [n, M', M'] of n matrices of M rows + jitter, whose rows and matrices have these strides.
// Returns how many do not exist.
int64_t factorise(int64_t size, const double *matrices, int64_t stride, int64_t row, double jitter, double *upper,
                  int64_t first, int64_t last) {
  int64_t failed = 0;
  for (int64_t i = first; i < last; i++)
    failed += !factorise_one(size, matrices + i * stride, row, jitter, given(upper, size, size, i));
  return failed;
}

// Inverses of the factors, see `Layer.inverse`. Returns 0.
int64_t invert(const Layer *layer, const double *upper, double *inverse, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing;
  for (int64_t c = first; c < last; c++)
    invert_chain(size, given(upper, size, size, c), given(inverse, size, size, 2 * c),
                 given(inverse, size, size, 2 * c + 1));
  return 0;
}

// Points x, those of a chain `stride` numbers behind those of the one before, over the lengthscales [C, n, D]; their
// correlations with the inducing inputs, times L^-1, [C, n', M']; and the slopes of these. Returns 0, or 1 if there was
// no memory.
int64_t see(const Layer *layer, int64_t num_points, const double *x, int64_t stride, double *scaled, double *projected,
            double *slope, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing;
  return with_memory<SeeBuffers>(*layer, 0, [&](const SeeBuffers &use) {
    for (int64_t c = first; c < last; c++)
      see_chain(*layer, Own(*layer, c), x + c * stride, num_points, scaled + c * num_points * layer->input_size,
                given(projected, num_points, size, c), given(slope, num_points, size, c), use);
  });
}

// Means [C, n, O] and variances [C, n], not below `least`, from what `see` projected. Returns as `see` does.
int64_t moments(const Layer *layer, int64_t outputs, const double *whitened, int64_t num_points, const double *scaled,
                const double *projected, double least, double *mean, double *variance, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing;
  return with_memory<MomentBuffers>(*layer, outputs, [&](const MomentBuffers &use) {
    for (int64_t c = first; c < last; c++)
      moments_chain(Own(*layer, c), outputs, whitened + c * size * outputs, num_points,
                    scaled + c * num_points * layer->input_size, given(projected, num_points, size, c), least, mean + c * num_points * outputs,
                    variance + c * num_points, use);
  });
}

// Gradients of what a layer was given from those of what it gave. Returns as `see` does.
int64_t back(const Layer *layer, const Points *points, int64_t first, int64_t last) {
  return with_memory<BackBuffers>(*layer, points->outputs, [&](const BackBuffers &use) {
    for (int64_t c = first; c < last; c++) back_chain(*layer, *points, c, use);
  });
}

// A diag(w) A^T of each of T rows of weights [C, T, n]: [C, T, M, M]. Returns as `see` does.
int64_t gram(const Layer *layer, int64_t num_points, const double *projected, int64_t num_weights,
             const double *weights, double *out, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing;
  return with_memory<GramBuffers>(*layer, 0, [&](const GramBuffers &use) {
    for (int64_t i = first * num_weights; i < last * num_weights; i++)
      gram_of(size, num_points, given(projected, num_points, size, i / num_weights), weights + i * num_points,
              out + i * size * size, use);
  });
}

// Copies the points for which `chosen` [C, n] says so: of one large matrix [C, n', M'] to another. Returns 0.
int64_t copy(const Layer *layer, int64_t num_points, const uint8_t *chosen, const double *from, double *to,
             int64_t first, int64_t last) {
  const int64_t width = padded(layer->num_inducing), rows = padded(num_points);
  for (int64_t c = first; c < last; c++)
    for (int64_t i = 0; i < num_points; i++)
      if (chosen[c * num_points + i])
        for (int64_t j = (c * rows + i) * width; j < (c * rows + i + 1) * width; j += LANES) at(to + j) = at(from + j);
  return 0;
}
}
