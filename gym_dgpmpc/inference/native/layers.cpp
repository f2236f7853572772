// One layer of C chains as training needs it, in double precision: kernel matrices, their products, and gradients.
//
// `inference/compiled_layers.py` calls this; `inference/gradients.py` has the same formulas in PyTorch, and says what
// they are. Per chain there are M inducing inputs and n points of D numbers, and O outputs. A call takes the chains
// first..last-1, which do not meet; several threads may call at the same time. Points are taken POINTS at a time, so
// that what lies between two products stays in the cache, and a product with a triangular matrix leaves the zeros out.
//
// Matrices inside have rows padded with zeros to whole vectors (`padded`), those of the caller have not. Built on the
// user's machine with its own vector width (GCC or Clang; see `compiler.py`). NaN goes through.

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
  int64_t kernel;             // see `kernel_number`
  int64_t num_inducing, input_size;  // M, D
  const double *lengthscale;  // [C, D]
  const double *variance;     // [C]
  const double *centres;      // [C, M, D], over the lengthscales
  const double *inverse;      // [C, M, M], lower triangular
  const double *own_slope;    // [C, M, M]
};
}

namespace {

inline vec all(double value) { return vec{} + value; }
inline int64_t rounded_up(int64_t size, int64_t unit) { return (size + unit - 1) / unit * unit; }
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

// c += a b over k = begin..end-1, for ROWS rows and some vectors of columns, which stay in registers.
template <int COUNT>
inline void tile(View a, Matrix b, Matrix c, int64_t i, int64_t j, int64_t begin, int64_t end) {
  vec sum[ROWS][COUNT];
#pragma GCC unroll 8
  for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 3
    for (int v = 0; v < COUNT; v++) sum[r][v] = at(c.row(i + r) + j + v * LANES);
  const double *left = a.values + i * a.row + begin * a.column;
  for (int64_t k = begin; k < end; k++, left += a.column) {
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

struct Range {
  int64_t begin, end;
};

// c += a b for rows first..last-1 and all columns of c; `range(i, j)` says which k count for the rows from i and the
// columns from j on, where j is the first and `j + VECTORS * LANES` beyond the last of a block. Columns are outside:
// theirs of b stay in the nearest cache.
template <class Ranges>
void product(View a, Matrix b, Matrix c, int64_t first, int64_t last, Ranges ranges) {
  for (int64_t j = 0; j < c.width; j += VECTORS * LANES)
    for (int64_t i = first; i < last; i += ROWS) {
      const Range range = ranges(i, j);
      if (range.begin >= range.end) continue;
      if (c.width - j >= VECTORS * LANES)
        tile<VECTORS>(a, b, c, i, j, range.begin, range.end);
      else if (c.width - j >= 2 * LANES)
        tile<2>(a, b, c, i, j, range.begin, range.end);
      else
        tile<1>(a, b, c, i, j, range.begin, range.end);
    }
}

inline Range every(int64_t count) { return {0, count}; }
inline int64_t larger(int64_t a, int64_t b) { return a > b ? a : b; }

void clear(Matrix m, int64_t rows) { memset(m.values, 0, rows * m.width * sizeof(double)); }

// Rows of the caller, `size` numbers each, into padded ones; zeros behind each, and in the rows up to `rows`.
void read(Matrix to, const double *from, int64_t count, int64_t size, int64_t rows) {
  for (int64_t i = 0; i < rows; i++) {
    const int64_t taken = i < count ? size : 0;
    memcpy(to.row(i), from + i * size, taken * sizeof(double));
    memset(to.row(i) + taken, 0, (to.width - taken) * sizeof(double));
  }
}

void write(double *to, Matrix from, int64_t count, int64_t size) {
  for (int64_t i = 0; i < count; i++) memcpy(to + i * size, from.row(i), size * sizeof(double));
}

// The transpose of the caller's [rows, columns], padded.
void read_transposed(Matrix to, const double *from, int64_t rows, int64_t columns) {
  clear(to, padded(columns));
  for (int64_t i = 0; i < rows; i++)
    for (int64_t j = 0; j < columns; j++) to.row(j)[i] = from[i * columns + j];
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
  Memory given((double *)memory);
  body(Buffers(given, layer, outputs));
  free(memory);
  return 0;
}

// What one chain has of a layer.
struct Own {
  int64_t size, inputs;  // M, D
  const double *lengthscale, *centres, *inverse, *own_slope;
  double variance;
  Own(const Layer &layer, int64_t chain)
      : size(layer.num_inducing),
        inputs(layer.input_size),
        lengthscale(layer.lengthscale + chain * inputs),
        centres(layer.centres + chain * size * inputs),
        inverse(layer.inverse + chain * size * size),
        own_slope(layer.own_slope + chain * size * size),
        variance(layer.variance[chain]) {}
};

// Squared distances of ROWS-padded points x, times -2, with the squares of their lengths, to M centres (transposed).
void distances(Matrix minus_twice, const double *squares, int64_t rows, Matrix centres, Matrix lengths, int64_t inputs,
               Matrix out) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t j = 0; j < out.width; j += LANES) at(out.row(i) + j) = squares[i] + at(lengths.values + j);
  product(minus_twice.view(), centres, out, 0, rows, [=](int64_t, int64_t) { return every(inputs); });
}

// The centres, transposed, and the squares of their lengths.
void read_centres(const Own &own, Matrix centres, Matrix lengths) {
  read_transposed(centres, own.centres, own.size, own.inputs);
  clear(lengths, 1);
  for (int64_t d = 0; d < own.inputs; d++)
    for (int64_t j = 0; j < centres.width; j += LANES)
      at(lengths.values + j) += at(centres.row(d) + j) * at(centres.row(d) + j);
}

struct SeeBuffers {
  Matrix centres, lengths, inverse, points, squares, values, slopes, projected;
  SeeBuffers(Memory &memory, const Layer &layer, int64_t)
      : centres(memory.matrix(layer.input_size, layer.num_inducing)),
        lengths(memory.matrix(1, layer.num_inducing)),
        inverse(memory.matrix(layer.num_inducing, layer.num_inducing)),
        points(memory.matrix(POINTS, layer.input_size)),
        squares(memory.matrix(1, POINTS)),
        values(memory.matrix(POINTS, layer.num_inducing)),
        slopes(memory.matrix(POINTS, layer.num_inducing)),
        projected(memory.matrix(POINTS, layer.num_inducing)) {}
};

// `rows` points, over the lengthscales, to the left factor of `distances`, and the squares of their lengths.
void prepare(Matrix points, double *squares, int64_t rows, int64_t inputs) {
  for (int64_t i = 0; i < rows; i++) {
    squares[i] = 0.0;
    for (int64_t d = 0; d < inputs; d++) {
      squares[i] += points.row(i)[d] * points.row(i)[d];
      points.row(i)[d] *= -2.0;
    }
    squares[i] += squares[i] - squares[i];  // NaN if infinite: such a point is none, rather than one that is far
  }
}

void see_chain(const Layer &layer, const Own &own, const double *x, int64_t num_points, double *scaled,
               double *projected, double *slope, const SeeBuffers &use) {
  const int64_t size = own.size, inputs = own.inputs;
  read_centres(own, use.centres, use.lengths);
  read_transposed(use.inverse, own.inverse, size, size);
  for (int64_t p = 0; p < num_points; p += POINTS) {
    const int64_t count = num_points - p < POINTS ? num_points - p : POINTS, rows = padded(count);
    for (int64_t i = p; i < p + count; i++)
      for (int64_t d = 0; d < inputs; d++) scaled[i * inputs + d] = x[i * inputs + d] / own.lengthscale[d];
    read(use.points, scaled + p * inputs, count, inputs, rows);
    prepare(use.points, use.squares.values, rows, inputs);
    distances(use.points, use.squares.values, rows, use.centres, use.lengths, inputs, use.values);
    KERNELS::entries[layer.kernel].evaluate(use.values.values, use.slopes.values, rows * use.values.width);
    write(slope + p * size, use.slopes, count, size);
    clear(use.projected, rows);
    product(use.values.view(), use.inverse, use.projected, 0, rows, [=](int64_t, int64_t j) {
      return every(j + VECTORS * LANES < size ? j + VECTORS * LANES : size);
    });
    write(projected + p * size, use.projected, count, size);
  }
}

struct MomentBuffers {
  Matrix whitened, projected, mean;
  MomentBuffers(Memory &memory, const Layer &layer, int64_t outputs)
      : whitened(memory.matrix(layer.num_inducing, outputs)),
        projected(memory.matrix(POINTS, layer.num_inducing)),
        mean(memory.matrix(POINTS, outputs)) {}
};

void moments_chain(const Own &own, int64_t outputs, const double *whitened, int64_t num_points,
                   const double *projected, double least, double *mean, double *variance, const MomentBuffers &use) {
  const int64_t size = own.size;
  read(use.whitened, whitened, size, outputs, padded(size));
  const double deviation = sqrt(own.variance);
  for (int64_t i = 0; i < size; i++)
    for (int64_t o = 0; o < outputs; o++) use.whitened.row(i)[o] *= deviation;
  for (int64_t p = 0; p < num_points; p += POINTS) {
    const int64_t count = num_points - p < POINTS ? num_points - p : POINTS, rows = padded(count);
    read(use.projected, projected + p * size, count, size, rows);
    clear(use.mean, rows);
    product(use.projected.view(), use.whitened, use.mean, 0, rows, [=](int64_t, int64_t) { return every(size); });
    write(mean + p * outputs, use.mean, count, outputs);
    for (int64_t i = 0; i < count; i++) {
      vec sum = {};
      for (int64_t j = 0; j < use.projected.width; j += LANES)
        sum += at(use.projected.row(i) + j) * at(use.projected.row(i) + j);
      double known = 0.0;
      for (int j = 0; j < LANES; j++) known += sum[j];
      const double left = own.variance * (1.0 - known);
      variance[p + i] = left < least ? least : left;
    }
  }
}

// Lower triangle of m += left^T right over `rows` rows, by whole blocks.
void add_lower(Matrix left, Matrix right, int64_t rows, Matrix m, int64_t size) {
  product(left.transposed(), right, m, 0, padded(size),
          [=](int64_t i, int64_t j) { return i + ROWS > j ? every(rows) : Range{0, 0}; });
}

struct BackBuffers {
  Matrix inverse, centres, whitened, projected, mean_bar, bar, product, slope, points, moved;
  Matrix whitened_bar, lower, left, both, own, by_point;
  BackBuffers(Memory &memory, const Layer &layer, int64_t outputs)
      : inverse(memory.matrix(layer.num_inducing, layer.num_inducing)),
        centres(memory.matrix(layer.num_inducing, layer.input_size + 1)),
        whitened(memory.matrix(outputs, layer.num_inducing)),
        projected(memory.matrix(POINTS, layer.num_inducing)),
        mean_bar(memory.matrix(POINTS, outputs)),
        bar(memory.matrix(POINTS, layer.num_inducing)),
        product(memory.matrix(POINTS, layer.num_inducing)),
        slope(memory.matrix(POINTS, layer.num_inducing)),
        points(memory.matrix(POINTS, layer.input_size + 1)),
        moved(memory.matrix(POINTS, layer.input_size + 1)),
        whitened_bar(memory.matrix(outputs, layer.num_inducing)),
        lower(memory.matrix(layer.num_inducing, layer.num_inducing)),
        left(memory.matrix(layer.num_inducing, layer.num_inducing)),
        both(memory.matrix(layer.num_inducing, layer.num_inducing)),
        own(memory.matrix(layer.num_inducing, layer.input_size + 1)),
        by_point(memory.matrix(layer.input_size + 1, layer.num_inducing)) {}
};

struct Points {
  int64_t count, outputs;     // n, O
  const double *whitened;     // [C, M, O]
  const double *scaled;       // [C, n, D]
  const double *projected;    // [C, n, M]
  const double *slope;        // [C, n, M]
  const double *mean_bar;     // [C, n, O]
  const double *variance_bar; // [C, n]
  double *whitened_bar;       // [C, M, O]
  double *scaled_bar;         // [C, n, D], or null where neither it nor centres_bar is wanted
  double *centres_bar;        // [C, M, D], or null
};

// Of the centres: through their distances to the points, and through the factor of their own correlations.
void centres_gradient(const Own &own, const BackBuffers &use, int64_t outputs, double *centres_bar) {
  const int64_t size = own.size, inputs = own.inputs, all_rows = padded(size);
  // `lower` has -2 variance A diag(variance_bar) A^T; now (L^-T mean_bar ...) of the means, a product of few columns.
  product(use.whitened.transposed(), use.whitened_bar, use.lower, 0, all_rows,
          [=](int64_t i, int64_t j) { return i + ROWS > j ? every(outputs) : Range{0, 0}; });
  for (int64_t i = 0; i < size; i++) {
    use.lower.row(i)[i] *= 0.5;
    memset(use.lower.row(i) + i + 1, 0, (use.lower.width - i - 1) * sizeof(double));
  }
  clear(use.left, all_rows);
  product(use.lower.view(), use.inverse, use.left, 0, all_rows,
          [=](int64_t i, int64_t j) { return Range{j, i + ROWS < size ? i + ROWS : size}; });
  clear(use.both, all_rows);
  product(use.inverse.transposed(), use.left, use.both, 0, all_rows,
          [=](int64_t i, int64_t j) { return Range{larger(i, j), size}; });
  // The symmetric part of it times the slope, which is symmetric, is half the sum of this and its transpose.
  read(use.left, own.own_slope, size, size, all_rows);
  for (int64_t i = 0; i < all_rows * use.both.width; i += LANES) at(use.both.values + i) *= at(use.left.values + i);
  clear(use.own, all_rows);
  for (const View half : {use.both.view(), use.both.transposed()})
    product(half, use.centres, use.own, 0, all_rows, [=](int64_t, int64_t) { return every(size); });
  for (int64_t i = 0; i < size; i++)
    for (int64_t d = 0; d < inputs; d++) {
      const double centre = own.centres[i * inputs + d];
      const double points = use.by_point.row(inputs)[i] * centre - use.by_point.row(d)[i];
      centres_bar[i * inputs + d] = 2.0 * points - 2.0 * (use.own.row(i)[inputs] * centre - use.own.row(i)[d]);
    }
}

void back_chain(const Layer &layer, const Points &points, int64_t chain, const BackBuffers &use) {
  const Own own(layer, chain);
  const int64_t size = own.size, inputs = own.inputs, outputs = points.outputs, num = points.count;
  const double deviation = sqrt(own.variance);
  const double *projected = points.projected + chain * num * size, *slope = points.slope + chain * num * size;
  const double *scaled = points.scaled + chain * num * inputs, *mean_bar = points.mean_bar + chain * num * outputs;
  const double *variance_bar = points.variance_bar + chain * num;
  const bool further = points.scaled_bar, of_centres = points.centres_bar;
  read_transposed(use.whitened, points.whitened + chain * size * outputs, size, outputs);
  clear(use.whitened_bar, padded(outputs));
  if (further) {
    read(use.inverse, own.inverse, size, size, padded(size));
    read(use.centres, own.centres, size, inputs, padded(size));
    for (int64_t i = 0; i < size; i++) use.centres.row(i)[inputs] = 1.0;
    clear(use.lower, padded(size));
    clear(use.by_point, padded(inputs + 1));
  }
  for (int64_t p = 0; p < num; p += POINTS) {
    const int64_t count = num - p < POINTS ? num - p : POINTS, rows = padded(count);
    const auto all_points = [=](int64_t, int64_t) { return every(rows); };
    read(use.projected, projected + p * size, count, size, rows);
    read(use.mean_bar, mean_bar + p * outputs, count, outputs, rows);
    for (int64_t i = 0; i < rows * use.mean_bar.width; i += LANES) at(use.mean_bar.values + i) *= deviation;
    product(use.mean_bar.transposed(), use.projected, use.whitened_bar, 0, padded(outputs), all_points);
    if (!further) continue;
    // The gradient of A by the variances, ...
    for (int64_t i = 0; i < rows; i++) {
      const double weight = i < count ? -2.0 * own.variance * variance_bar[p + i] : 0.0;
      for (int64_t j = 0; j < use.bar.width; j += LANES)
        at(use.bar.row(i) + j) = weight * at(use.projected.row(i) + j);
    }
    if (of_centres) add_lower(use.bar, use.projected, rows, use.lower, size);
    // ... and by the means, of the correlations, and of the squared distances.
    product(use.mean_bar.view(), use.whitened, use.bar, 0, rows, [=](int64_t, int64_t) { return every(outputs); });
    clear(use.product, rows);
    product(use.bar.view(), use.inverse, use.product, 0, rows,
            [=](int64_t, int64_t j) { return Range{j, size}; });
    read(use.slope, slope + p * size, count, size, rows);
    for (int64_t i = 0; i < rows * use.slope.width; i += LANES)
      at(use.product.values + i) *= at(use.slope.values + i);
    // By a last column of ones the sums come with the products.
    clear(use.moved, rows);
    product(use.product.view(), use.centres, use.moved, 0, rows, [=](int64_t, int64_t) { return every(size); });
    for (int64_t i = 0; i < count; i++)
      for (int64_t d = 0; d < inputs; d++) {
        const int64_t n = (p + i) * inputs + d;
        points.scaled_bar[chain * num * inputs + n] =
            2.0 * (use.moved.row(i)[inputs] * scaled[n] - use.moved.row(i)[d]);
      }
    if (!of_centres) continue;
    read(use.points, scaled + p * inputs, count, inputs, rows);
    for (int64_t i = 0; i < count; i++) use.points.row(i)[inputs] = 1.0;
    product(use.points.transposed(), use.product, use.by_point, 0, padded(inputs + 1), all_points);
  }
  double *whitened_bar = points.whitened_bar + chain * size * outputs;
  for (int64_t i = 0; i < size; i++)
    for (int64_t o = 0; o < outputs; o++) whitened_bar[i * outputs + o] = use.whitened_bar.row(o)[i];
  if (of_centres) centres_gradient(own, use, outputs, points.centres_bar + chain * size * inputs);
}

struct GramBuffers {
  Matrix projected, weighted, sum;
  GramBuffers(Memory &memory, const Layer &layer, int64_t)
      : projected(memory.matrix(POINTS, layer.num_inducing)),
        weighted(memory.matrix(POINTS, layer.num_inducing)),
        sum(memory.matrix(layer.num_inducing, layer.num_inducing)) {}
};

void gram_of(int64_t size, int64_t num_points, const double *projected, const double *weights, double *out,
             const GramBuffers &use) {
  clear(use.sum, padded(size));
  for (int64_t p = 0; p < num_points; p += POINTS) {
    const int64_t count = num_points - p < POINTS ? num_points - p : POINTS, rows = padded(count);
    read(use.projected, projected + p * size, count, size, rows);
    for (int64_t i = 0; i < rows; i++)
      for (int64_t j = 0; j < use.weighted.width; j += LANES)
        at(use.weighted.row(i) + j) = (i < count ? weights[p + i] : 0.0) * at(use.projected.row(i) + j);
    add_lower(use.weighted, use.projected, rows, use.sum, size);
  }
  for (int64_t i = 0; i < size; i++)
    for (int64_t j = 0; j <= i; j++) out[i * size + j] = out[j * size + i] = use.sum.row(i)[j];
}

struct OwnBuffers {
  Matrix centres, lengths, points, squares, values, slopes;
  OwnBuffers(Memory &memory, const Layer &layer, int64_t)
      : centres(memory.matrix(layer.input_size, layer.num_inducing)),
        lengths(memory.matrix(1, layer.num_inducing)),
        points(memory.matrix(layer.num_inducing, layer.input_size)),
        squares(memory.matrix(1, layer.num_inducing)),
        values(memory.matrix(layer.num_inducing, layer.num_inducing)),
        slopes(memory.matrix(layer.num_inducing, layer.num_inducing)) {}
};

void own_chain(const Layer &layer, const Own &own, double *value, double *slope, const OwnBuffers &use) {
  const int64_t size = own.size, rows = padded(size);
  read_centres(own, use.centres, use.lengths);
  read(use.points, own.centres, size, own.inputs, rows);
  prepare(use.points, use.squares.values, rows, own.inputs);
  distances(use.points, use.squares.values, rows, use.centres, use.lengths, own.inputs, use.values);
  KERNELS::entries[layer.kernel].evaluate(use.values.values, use.slopes.values, rows * use.values.width);
  write(value, use.values, size, size);
  write(slope, use.slopes, size, size);
}

struct InverseBuffers {
  Matrix factor, inverse;
  InverseBuffers(Memory &memory, const Layer &layer, int64_t)
      : factor(memory.matrix(layer.num_inducing, layer.num_inducing)),
        inverse(memory.matrix(layer.num_inducing, layer.num_inducing)) {}
};

// By forward substitution: the rows of a block less what those before the block say, then one after the other.
void invert_chain(int64_t size, const double *factor, double *inverse, const InverseBuffers &use) {
  const int64_t all_rows = padded(size);
  read_transposed(use.factor, factor, size, size);  // LAPACK's columns are the caller's rows
  clear(use.inverse, all_rows);
  for (int64_t first = 0; first < size; first += ROWS) {
    product(use.factor.view(), use.inverse, use.inverse, first, first + ROWS,
            [=](int64_t, int64_t j) { return Range{j, first}; });
    for (int64_t i = first; i < first + ROWS && i < size; i++) {
      double *row = use.inverse.row(i);
      for (int64_t k = first; k < i; k++)
        for (int64_t j = 0; j < first + ROWS; j += LANES)
          at(row + j) += use.factor.row(i)[k] * at(use.inverse.row(k) + j);
      row[i] -= 1.0;
      const double scale = -1.0 / use.factor.row(i)[i];
      for (int64_t j = 0; j < first + ROWS; j += LANES) at(row + j) *= scale;
    }
  }
  write(inverse, use.inverse, size, size);
}

}  // namespace

extern "C" {

// The number by which a Layer names this kernel; -1 if it is not here.
int64_t kernel_number(const char *name) {
  for (int64_t i = 0; i < KERNELS::size; i++)
    if (!strcmp(KERNELS::entries[i].name, name)) return i;
  return -1;
}

// All return 0, or 1 if there was no memory.

// Correlations of the inducing inputs, and their slopes: [C, M, M].
int64_t own_correlations(const Layer *layer, double *value, double *slope, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing * layer->num_inducing;
  return with_memory<OwnBuffers>(*layer, 0, [&](const OwnBuffers &use) {
    for (int64_t c = first; c < last; c++) own_chain(*layer, Own(*layer, c), value + c * size, slope + c * size, use);
  });
}

// Inverses of lower triangular matrices, which are given by their columns: [C, M, M].
int64_t invert(const Layer *layer, const double *factor, double *inverse, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing * layer->num_inducing;
  return with_memory<InverseBuffers>(*layer, 0, [&](const InverseBuffers &use) {
    for (int64_t c = first; c < last; c++)
      invert_chain(layer->num_inducing, factor + c * size, inverse + c * size, use);
  });
}

// Points x, those of a chain `stride` numbers behind those of the one before, over the lengthscales [C, n, D]; their
// correlations with the inducing inputs, times L^-1, [C, n, M]; and the slopes of these.
int64_t see(const Layer *layer, int64_t num_points, const double *x, int64_t stride, double *scaled, double *projected,
            double *slope, int64_t first, int64_t last) {
  const int64_t row = num_points * layer->num_inducing;
  return with_memory<SeeBuffers>(*layer, 0, [&](const SeeBuffers &use) {
    for (int64_t c = first; c < last; c++)
      see_chain(*layer, Own(*layer, c), x + c * stride, num_points, scaled + c * num_points * layer->input_size,
                projected + c * row, slope + c * row, use);
  });
}

// Means [C, n, O] and variances [C, n], not below `least`, from what `see` projected.
int64_t moments(const Layer *layer, int64_t outputs, const double *whitened, int64_t num_points,
                const double *projected, double least, double *mean, double *variance, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing;
  return with_memory<MomentBuffers>(*layer, outputs, [&](const MomentBuffers &use) {
    for (int64_t c = first; c < last; c++)
      moments_chain(Own(*layer, c), outputs, whitened + c * size * outputs, num_points,
                    projected + c * num_points * size, least, mean + c * num_points * outputs,
                    variance + c * num_points, use);
  });
}

// Gradients of what a layer was given from those of what it gave.
int64_t back(const Layer *layer, const Points *points, int64_t first, int64_t last) {
  return with_memory<BackBuffers>(*layer, points->outputs, [&](const BackBuffers &use) {
    for (int64_t c = first; c < last; c++) back_chain(*layer, *points, c, use);
  });
}

// A diag(w) A^T of each of T rows of weights [C, T, n]: [C, T, M, M].
int64_t gram(const Layer *layer, int64_t num_points, const double *projected, int64_t num_weights,
             const double *weights, double *out, int64_t first, int64_t last) {
  const int64_t size = layer->num_inducing;
  return with_memory<GramBuffers>(*layer, 0, [&](const GramBuffers &use) {
    for (int64_t i = first * num_weights; i < last * num_weights; i++)
      gram_of(size, num_points, projected + i / num_weights * num_points * size, weights + i * num_points,
              out + i * size * size, use);
  });
}
}
