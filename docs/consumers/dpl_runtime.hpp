// Real-time simulator of one exported body: C++17, no dependencies. See docs/consumers.md.
//
//   dpl::Simulator sim = dpl::Simulator::open("export/runtime.safetensors");
//   const dpl::Answer& answer = sim.solve(force);  // nodal forces (N, 3) [N]
//
// Compile with -O3 -march=native; right with any flags but -ffast-math, which drops NaN. A Simulator
// has its own work arrays: use one for each thread. Numbers and files are little-endian.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

#ifdef __FAST_MATH__
#error "dpl_runtime.hpp: compile without -ffast-math"
#endif

namespace dpl {

struct Error : std::runtime_error {
  using std::runtime_error::runtime_error;
};

enum class Range { unknown = -1, outside = 0, inside = 1 };  // of the loads of the training

struct Answer {
  std::vector<double> displacement;  // (N, 3) [m]
  double error = 0;                  // estimated relative error of the displacement [-]
  double residual = 0;               // ||f_int - f|| / ||f|| at free degrees of freedom [-]
  double min_det_F = 0;              // an element is inverted unless it is above 0 [-]
  double amplitude = 0;              // size of the load over the largest of the training [-]
  double out_of_span = 0;            // part of the force unlike any load of the training [-]; or NaN
  Range range = Range::unknown;
  std::vector<double> sizes;  // norms of the linear coordinates and of the correction by each map [-]
};

struct Patch {
  std::vector<int> nodes;
  std::vector<double> weights;  // part of the total force at each node, their sum is 1
};

namespace detail {
using Doubles = std::vector<double>;

// ---------------------------------------------------------------- SIMD: W lanes of a block of L
constexpr int L = 8;
#if defined(__GNUC__) && !defined(DPL_SCALAR)
#if defined(__AVX512F__)
constexpr int W = 8;
#elif defined(__AVX__)
constexpr int W = 4;
#else
constexpr int W = 2;
#endif
typedef double V __attribute__((vector_size(8 * W)));
typedef float F __attribute__((vector_size(4 * W)));
typedef float Floats __attribute__((vector_size(8 * W)));
typedef std::int16_t Shorts __attribute__((vector_size(4 * W)));
typedef std::int64_t I __attribute__((vector_size(8 * W)));
#define DPL_INLINE inline __attribute__((always_inline))
DPL_INLINE V widen(F x) { return __builtin_convertvector(x, V); }
DPL_INLINE Floats widen(Shorts x) { return __builtin_convertvector(x, Floats); }
#else
constexpr int W = 1;
using V = double;
using F = float;
using Floats = float;
using Shorts = std::int16_t;
#define DPL_INLINE inline
DPL_INLINE V widen(F x) { return x; }
DPL_INLINE Floats widen(Shorts x) { return x; }
#endif

template <class To, class From> DPL_INLINE To bits(const From& from) {
  static_assert(sizeof(To) == sizeof(From), "sizes");
  To to;
  std::memcpy(&to, &from, sizeof to);
  return to;
}
template <class Vector, class T> DPL_INLINE Vector read(const T* p) {
  Vector v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
DPL_INLINE V load(const double* p) { return read<V>(p); }
template <class T, class Vector> DPL_INLINE void store(T* p, Vector v) { std::memcpy(p, &v, sizeof v); }
DPL_INLINE V all(double x) { return V{} + x; }
// Vectors of the type T of sums, of numbers of this type or of half its size.
template <class T> using Sums = typename std::conditional<std::is_same<T, float>::value, Floats, V>::type;
template <class T> using Half = typename std::conditional<std::is_same<T, float>::value, Shorts, F>::type;
template <class T, class Number> DPL_INLINE Sums<T> load_as(const Number* p) {
  if constexpr (std::is_same<T, Number>::value) return read<Sums<T>>(p);
  else return widen(read<Half<T>>(p));
}
template <class T> DPL_INLINE T sum(Sums<T> v) {
  T lanes[sizeof v / sizeof(T)], total = 0;
  store(lanes, v);
  for (T x : lanes) total += x;
  return total;
}

#if defined(__GNUC__) && !defined(DPL_SCALAR)
constexpr double SHIFT = 6755399441055744.0;  // 1.5 * 2^52: its last bits hold small integers
constexpr double LN2_HIGH = 6.93147180369123816490e-01, LN2_LOW = 1.90821492927058770002e-10;
DPL_INLINE V log1p(V x) {  // 2 atanh(f / (2 + f)) + k ln 2 with 1 + x = 2^k (1 + f)
  const I y = bits<I>(x > -1.0 ? 1.0 + x : all(1.0)), k = (y - 0x3fe6a09e667f3bcd) >> 52;
  const V whole = bits<V>(k + bits<I>(all(SHIFT))) - SHIFT, f = k == 0 ? x : bits<V>(y - (k << 52)) - 1.0;
  const V s = f / (2.0 + f), z = s * s;
  V series = all(2.0 / 21);
  for (int n = 19; n > 1; n -= 2) series = series * z + 2.0 / n;
  const V found = whole * LN2_HIGH + (whole * LN2_LOW + s * (2.0 + z * series));
  return x > -1.0 ? found : all(std::numeric_limits<double>::quiet_NaN());
}
DPL_INLINE V expm1(V x) {  // 2^n (e^r - 1) + 2^n - 1
  x = x < -700.0 ? all(-700.0) : x;
  x = x > 700.0 ? all(700.0) : x;
  const V shifted = x * 1.44269504088896340736 + SHIFT, n = shifted - SHIFT;
  const V r = (x - n * LN2_HIGH) - n * LN2_LOW;
  V series = all(1.0 / 14);
  for (int k = 13; k > 1; --k) series = (1.0 + r * series) * (1.0 / k);
  const V power = bits<V>((bits<I>(shifted) - bits<I>(all(SHIFT)) + 1023) << 52);
  return power * (r + r * r * series) + (power - 1.0);
}
#else
using std::expm1;
using std::log1p;
#endif

// ---------------------------------------------------------------- products of matrices and vectors
// Prefetch what follows four rows at column j by 8 KB: short rows mislead the prefetcher of processors.
template <class T> DPL_INLINE void prefetch(const T* rows, int j) {
#if defined(__GNUC__)
  const std::uintptr_t ahead = reinterpret_cast<std::uintptr_t>(rows) + 8192 + 4 * sizeof(T) * std::size_t(j);
  __builtin_prefetch(reinterpret_cast<const void*>(ahead));
  __builtin_prefetch(reinterpret_cast<const void*>(ahead + 64));
#else
  (void)rows, (void)j;
#endif
}
template <class T, class Number>
inline void add_product(const T* x, const Number* A, int rows, int n, T* y) {  // y += x A
  constexpr int lanes = sizeof(Sums<T>) / sizeof(T);
  int i = 0;
  for (; i + 4 <= rows; i += 4) {
    const T a = x[i], b = x[i + 1], c = x[i + 2], d = x[i + 3];
    if (a == 0 && b == 0 && c == 0 && d == 0) continue;
    const Number *p = A + std::size_t(i) * n, *q = p + n, *r = q + n, *s = r + n;
    int j = 0;
    for (; j + lanes <= n; j += lanes) {
      prefetch(p, j);
      store(y + j, load_as<T>(y + j) + (a * load_as<T>(p + j) + b * load_as<T>(q + j)) + (c * load_as<T>(r + j) + d * load_as<T>(s + j)));
    }
    for (; j < n; ++j) y[j] += (a * p[j] + b * q[j]) + (c * r[j] + d * s[j]);
  }
  for (; i < rows; ++i)
    for (int j = 0; j < n; ++j) y[j] += x[i] * A[std::size_t(i) * n + j];
}
template <class T, class Number> inline T dot(const T* x, const Number* row, int n) {
  constexpr int lanes = sizeof(Sums<T>) / sizeof(T);
  Sums<T> total = {}, other = {};
  int j = 0;
  for (; j + 2 * lanes <= n; j += 2 * lanes) {
    total += load_as<T>(x + j) * load_as<T>(row + j);
    other += load_as<T>(x + j + lanes) * load_as<T>(row + j + lanes);
  }
  T rest = 0;
  for (; j < n; ++j) rest += x[j] * row[j];
  return sum<T>(total + other) + rest;
}
template <class T, class Number>
inline void subtract_product(const Number* A, const T* x, int rows, int n, T* y) {  // y -= A x
  constexpr int lanes = sizeof(Sums<T>) / sizeof(T);
  int i = 0;
  for (; i + 4 <= rows; i += 4) {
    const Number *p = A + std::size_t(i) * n, *q = p + n, *r = q + n, *s = r + n;
    Sums<T> a = {}, b = {}, c = {}, d = {};
    int j = 0;
    for (; j + lanes <= n; j += lanes) {
      const Sums<T> v = load_as<T>(x + j);
      prefetch(p, j);
      a += load_as<T>(p + j) * v, b += load_as<T>(q + j) * v, c += load_as<T>(r + j) * v, d += load_as<T>(s + j) * v;
    }
    T rest[4] = {sum<T>(a), sum<T>(b), sum<T>(c), sum<T>(d)};
    for (; j < n; ++j) rest[0] += p[j] * x[j], rest[1] += q[j] * x[j], rest[2] += r[j] * x[j], rest[3] += s[j] * x[j];
    for (int k = 0; k < 4; ++k) y[i + k] -= rest[k];
  }
  for (; i < rows; ++i) y[i] -= dot(x, A + std::size_t(i) * n, n);
}
inline double norm(const std::vector<double>& x) {
  const double square = dot(x.data(), x.data(), int(x.size()));
  if (square > 1e-280 && square < 1e280) return std::sqrt(square);
  double largest = 0;
  for (double v : x) {
    if (v != v) return v;
    largest = std::max(largest, std::abs(v));
  }
  if (!(largest > 0) || !std::isfinite(largest)) return largest;
  double total = 0;
  for (double v : x) total += (v / largest) * (v / largest);
  return largest * std::sqrt(total);
}

// ---------------------------------------------------------------- laws: dpl.fem.materials
// rest, W2 and p of `InvariantBasedMaterial.invariant_derivatives`; the constants are dimensionless.
struct Terms {
  V rest, W2, p;
};
struct Hooke {  // lambda, mu; of the strain of Green and Lagrange: Saint Venant-Kirchhoff
  static constexpr int constants = 2, needs = 0;
  static constexpr bool finite = true, has_W2 = true;
  static DPL_INLINE Terms at(const V* c, V i1, V, V, V, V) {
    return {(0.5 * c[0] + c[1]) * i1, -0.5 * c[1], V{}};
  }
};
struct SmallHooke : Hooke {
  static constexpr bool finite = false;
};
struct NeoHookeanLn {  // lambda, mu
  static constexpr int constants = 2, needs = 2;
  static constexpr bool finite = true, has_W2 = false;
  static DPL_INLINE Terms at(const V* c, V, V, V, V log_j, V) {
    return {c[0] * log_j, V{}, c[0] * log_j - c[1]};
  }
};
struct StableNeoHookean {  // m, l
  static constexpr int constants = 2, needs = 1;
  static constexpr bool finite = true, has_W2 = false;
  static DPL_INLINE Terms at(const V* c, V i1, V, V j, V, V) {
    const V volume = c[1] * j * (1.0 + j) - 0.75 * c[0] * j;
    return {volume + 0.25 * c[0] * i1 / (4.0 + i1), V{}, volume - 0.75 * c[0]};
  }
};
DPL_INLINE Terms isochoric(V f1, V f2, V i1, V i2, V m1, V volumetric) {
  const V m = 1.0 + m1, W2 = f2 * m * m;
  const V I1 = m * i1 + 3.0 * m1 + 3.0, I2 = m * m * (3.0 + i2);
  return {volumetric - 2. / 3 * f1 * m * i1 - 4. / 3 * W2 * i2, W2, volumetric - 2. / 3 * f1 * I1 - 4. / 3 * f2 * I2};
}
template <bool quartic> struct Polynomial {  // c10, c20, c30, c01, bulk
  static constexpr int constants = 5, needs = 3;
  static constexpr bool finite = true, has_W2 = true;
  static DPL_INLINE Terms at(const V* c, V i1, V i2, V j, V, V m1) {
    const V x = (1.0 + m1) * i1 + 3.0 * m1, f1 = c[0] + x * (2.0 * c[1] + 3.0 * c[2] * x);
    return isochoric(f1, c[3], i1, i2, m1, quartic ? 0.5 * c[4] * j * (2.0 + j) : c[4] * j * (1.0 + j));
  }
};
struct Demiray {  // a/2, b, bulk
  static constexpr int constants = 3, needs = 3;
  static constexpr bool finite = true, has_W2 = false;
  static DPL_INLINE Terms at(const V* c, V i1, V i2, V j, V, V m1) {
    const V f1 = c[0] * (1.0 + expm1(c[1] * ((1.0 + m1) * i1 + 3.0 * m1)));
    return isochoric(f1, V{}, i1, i2, m1, c[2] * j * (1.0 + j));
  }
};

DPL_INLINE V volume_change(const V* H) {  // det(I + H) - 1
  const V a = H[0], b = H[1], c = H[2], d = H[3], e = H[4], f = H[5], g = H[6], h = H[7], i = H[8];
  return a + e + i + (a * e - b * d + e * i - f * h + a * i - c * g) + a * (e * i - f * h) - b * (d * i - f * g) +
         c * (d * h - e * g);
}
template <class Law> DPL_INLINE void piola(const V* c, const V* H, V j, V* P) {  // of det F = 1 + j
  V e[6], S[6], log_j = V{}, m1 = V{};  // e = 2 E, in the order 11 22 33 12 23 13
  constexpr int first[6] = {0, 1, 2, 0, 1, 0}, second[6] = {0, 1, 2, 1, 2, 2};
  constexpr int place[3][3] = {{0, 3, 5}, {3, 1, 4}, {5, 4, 2}};
  for (int v = 0; v < 6; ++v) {
    const int i = first[v], k = second[v];
    e[v] = H[3 * i + k] + H[3 * k + i];
    if (Law::finite) e[v] += H[i] * H[k] + H[3 + i] * H[3 + k] + H[6 + i] * H[6 + k];
  }
  const V minors[6] = {e[1] * e[2] - e[4] * e[4], e[0] * e[2] - e[5] * e[5], e[0] * e[1] - e[3] * e[3],
                       e[4] * e[5] - e[2] * e[3], e[3] * e[5] - e[0] * e[4], e[3] * e[4] - e[1] * e[5]};
  const V i1 = e[0] + e[1] + e[2], m = minors[0] + minors[1] + minors[2], i2 = 2.0 * i1 + m;
  if (Law::needs > 1) log_j = log1p(j);
  if (Law::needs > 2) m1 = expm1(-2. / 3 * log_j);
  const Terms t = Law::at(c, i1, i2, j, log_j, m1);
  // I - C^-1 = (e + beyond I - minors) / det C with det C = 1 + i1 + beyond, without differences of large numbers
  const V beyond = m + e[0] * minors[0] + e[3] * minors[3] + e[5] * minors[5], factor = Law::needs > 0 ? t.p / (1.0 + i1 + beyond) : V{};
  V pressure = t.rest;
  if (Law::has_W2) pressure += 2.0 * t.W2 * i1;
  if (Law::needs > 0) pressure -= factor * beyond;
  for (int v = 0; v < 6; ++v) {
    S[v] = v < 3 ? pressure : V{};
    if (Law::has_W2) S[v] -= 2.0 * t.W2 * e[v];
    if (Law::needs > 0) S[v] -= factor * (e[v] - minors[v]);
  }
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) {
      P[3 * i + k] = S[place[i][k]];
      if (Law::finite) P[3 * i + k] += H[3 * i] * S[place[0][k]] + H[3 * i + 1] * S[place[1][k]] + H[3 * i + 2] * S[place[2][k]];
    }
}
DPL_INLINE V cofactors(const V* X, V* out) {  // returns det X
  for (int i = 0; i < 3; ++i)
    for (int c = 0; c < 3; ++c) {
      const int j = (i + 1) % 3, k = (i + 2) % 3, d = (c + 1) % 3, e = (c + 2) % 3;
      out[3 * i + c] = X[3 * j + d] * X[3 * k + e] - X[3 * j + e] * X[3 * k + d];
    }
  return X[0] * out[0] + X[1] * out[1] + X[2] * out[2];
}
DPL_INLINE void rotation(V* X, int iterations) {  // Newton's iteration of the polar decomposition
  V minors[9];
  for (int n = 0; n < iterations; ++n) {
    const V half = 0.5 / cofactors(X, minors);
    for (int r = 0; r < 9; ++r) X[r] = 0.5 * X[r] + half * minors[r];
  }
}

// ---------------------------------------------------------------- sample cells: rows of L lanes
inline void rotated_strain(const double* H, double* out) {  // feature_loops.rotated_strain
  double first[L], second[L];
  for (int k = 0; k < L; ++k) {
    const double a = 0.5 * (H[7 * L + k] - H[5 * L + k]), b = 0.5 * (H[2 * L + k] - H[6 * L + k]), c = 0.5 * (H[3 * L + k] - H[L + k]);
    const double s = a * a + b * b + c * c, angle = std::sqrt(s);
    const bool series = s < 0.09;
    first[k] = series ? -s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72))) : std::sin(angle) / angle - 1;
    second[k] = series ? 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90))) : (1 - std::cos(angle)) / s;
  }
  for (int l = 0; l < L; l += W) {
    V h[9];
    for (int r = 0; r < 9; ++r) h[r] = load(H + L * r + l);
    const V w[3] = {0.5 * (h[7] - h[5]), 0.5 * (h[2] - h[6]), 0.5 * (h[3] - h[1])}, zero = V{};
    const V square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], f = load(first + l), g = load(second + l);
    const V spin[9] = {zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero};
    V turn[9];  // e^W - I - W
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) turn[3 * i + j] = f * spin[3 * i + j] + g * (w[i] * w[j] - (i == j ? square : zero));
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        V total = turn[3 * i + j];
        for (int m = 0; m < 3; ++m) total += (spin[3 * i + m] + turn[3 * i + m]) * (0.5 * (h[3 * m + j] + h[3 * j + m]));
        store(out + L * (3 * i + j) + l, total);
      }
  }
}
template <class Law>
void unbalanced_stress(const double* c, const double* H, const double* linear, double* out) {
  for (int l = 0; l < L; l += W) {
    V h[9], h0[9], P[9], X[9], constants[Law::constants];
    for (int r = 0; r < 9; ++r) h[r] = load(H + L * r + l), h0[r] = load(linear + L * r + l);
    for (int r = 0; r < Law::constants; ++r) constants[r] = load(c + L * r + l);
    const V mu = load(c + L * Law::constants + l), lambda = load(c + L * (Law::constants + 1) + l);
    const V change = volume_change(h);
    for (int r = 0; r < 9; ++r) h[r] = change > 0.05 - 1 ? h[r] : V{};  // collapsed: as undeformed
    piola<Law>(constants, h, volume_change(h), P);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const int r = 3 * i + j;
        P[r] -= mu * (h0[r] + h0[3 * j + i]);
        if (i == j) P[r] -= lambda * (h0[0] + h0[4] + h0[8]);
        store(out + L * (9 + r) + l, P[r]);
        X[r] = i == j ? h[r] + 1.0 : h[r];
      }
    rotation(X, 5);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) store(out + L * (3 * i + j) + l, X[i] * P[j] + X[3 + i] * P[3 + j] + X[6 + i] * P[6 + j]);
  }
}

// ---------------------------------------------------------------- cells
struct Cells {  // blocks of L cells; the last one is filled with copies of the last cell
  int count = 0, nodes = 0, points = 0, blocks = 0;
  std::size_t shape_step = 0, law_step = 0;  // 0: the same for all blocks
  std::vector<int> dofs;                     // first degree of freedom of each node, (blocks, A, L)
  std::vector<double> dN, dV, law;           // (blocks or 1, Q, 3 A, L), (.., Q, L), (.., n, L)
  std::vector<double> integrals;             // of dN over a cell, (blocks or 1, 3 A, L)
};
constexpr int MOST_NODES = 27, MOST_CONSTANTS = 5;

template <int A> DPL_INLINE void gather(const Cells& cells, int block, const double* u, double* ue) {
  const int n = A ? A : cells.nodes;
  const int* dofs = cells.dofs.data() + std::size_t(block) * n * L;
  for (int a = 0; a < n; ++a)
    for (int l = 0; l < L; ++l)
      for (int i = 0; i < 3; ++i) ue[(3 * a + i) * L + l] = u[dofs[a * L + l] + i];
}
template <int A> DPL_INLINE void gradient(const double* ue, const double* g, int nodes, V* H) {
  for (int r = 0; r < 9; ++r) H[r] = V{};
  for (int a = 0; a < (A ? A : nodes); ++a) {
    const V g0 = load(g + 3 * a * L), g1 = load(g + (3 * a + 1) * L), g2 = load(g + (3 * a + 2) * L);
    for (int i = 0; i < 3; ++i) {
      const V v = load(ue + (3 * a + i) * L);
      H[3 * i] += v * g0, H[3 * i + 1] += v * g1, H[3 * i + 2] += v * g2;
    }
  }
}
// Add f_int (N, 3) of u (N, 3) to f; return min det F - 1, NaN where a gradient is not a number.
template <class Law, int A> double internal_force(const Cells& cells, const double* u, double* f) {
  const int n = A ? A : cells.nodes, Q = cells.points;
  double ue[3 * MOST_NODES * L], fe[3 * MOST_NODES * L], lowest = std::numeric_limits<double>::infinity();
  for (int block = 0; block < cells.blocks; ++block) {
    gather<A>(cells, block, u, ue);
    const double *dN = cells.dN.data() + block * cells.shape_step * Q * 3 * n, *dV = cells.dV.data() + block * cells.shape_step * Q;
    const double* law = cells.law.data() + block * cells.law_step;
    for (int l = 0; l < L; l += W) {
      V force[3 * (A ? A : MOST_NODES)], H[9], P[9], constants[Law::constants], low = all(lowest);
      for (int r = 0; r < 3 * n; ++r) force[r] = V{};
      for (int r = 0; r < Law::constants; ++r) constants[r] = load(law + L * r + l);
      for (int q = 0; q < Q; ++q) {
        const double* g = dN + q * 3 * n * L + l;
        gradient<A>(ue + l, g, n, H);
        const V change = volume_change(H), weight = load(dV + q * L + l);
        low = change < low ? change : low;
        low = change == change ? low : change;
        piola<Law>(constants, H, change, P);
        for (int r = 0; r < 9; ++r) P[r] *= weight;
        for (int a = 0; a < n; ++a) {
          const V g0 = load(g + 3 * a * L), g1 = load(g + (3 * a + 1) * L), g2 = load(g + (3 * a + 2) * L);
          for (int i = 0; i < 3; ++i) force[3 * a + i] += P[3 * i] * g0 + P[3 * i + 1] * g1 + P[3 * i + 2] * g2;
        }
      }
      for (int r = 0; r < 3 * n; ++r) store(fe + r * L + l, force[r]);
      double lanes[W];
      store(lanes, low);
      for (double x : lanes) lowest = x < lowest || x != x ? x : lowest;
    }
    const int* dofs = cells.dofs.data() + std::size_t(block) * n * L;
    const int filled = std::min(L, cells.count - block * L);
    for (int a = 0; a < n; ++a)
      for (int l = 0; l < filled; ++l)
        for (int i = 0; i < 3; ++i) f[dofs[a * L + l] + i] += fe[(3 * a + i) * L + l];
  }
  return lowest;
}
// Add the volume integral of H over the cells of each node, (N, 9).
inline void add_node_gradients(const Cells& cells, const double* u, double* sums) {
  double ue[3 * MOST_NODES * L], lanes[W], rows[9 * L];
  const int n = cells.nodes;
  for (int block = 0; block < cells.blocks; ++block) {
    gather<0>(cells, block, u, ue);
    const double* integral = cells.integrals.data() + block * cells.shape_step * 3 * n;
    for (int l = 0; l < L; l += W) {
      V H[9];
      gradient<0>(ue + l, integral + l, n, H);
      for (int r = 0; r < 9; ++r) {
        store(lanes, H[r]);
        for (int k = 0; k < W; ++k) rows[9 * (l + k) + r] = lanes[k];
      }
    }
    const int* dofs = cells.dofs.data() + std::size_t(block) * n * L;
    for (int l = 0; l < std::min(L, cells.count - block * L); ++l)
      for (int a = 0; a < n; ++a)
        for (int r = 0; r < 9; ++r) sums[3 * dofs[a * L + l] + r] += rows[9 * l + r];
  }
}

struct LawFunctions {
  const char* name;
  int constants;
  void (*stress)(const double*, const double*, const double*, double*);
  double (*force)(const Cells&, const double*, double*);
  double (*force_of_hexahedra)(const Cells&, const double*, double*);
};
template <class Law> constexpr LawFunctions functions(const char* name) {
  return {name, Law::constants, unbalanced_stress<Law>, internal_force<Law, 0>, internal_force<Law, 8>};
}
inline LawFunctions law_named(const std::string& name) {
  static const LawFunctions laws[] = {
      functions<NeoHookeanLn>("neo_hookean_ln"), functions<Hooke>("hooke"), functions<SmallHooke>("hooke_small_strains"),
      functions<StableNeoHookean>("stable_neo_hookean"), functions<Polynomial<false>>("polynomial_k2"),
      functions<Polynomial<true>>("polynomial_k4"), functions<Demiray>("demiray_k2")};
  for (const LawFunctions& law : laws)
    if (name == law.name) return law;
  throw Error("law = " + name.substr(0, 40) + " is unknown; update dpl_runtime.hpp");
}

// ---------------------------------------------------------------- file: safetensors, checked
// 8 bytes length of the header, JSON {"name": {"dtype", "shape", "data_offsets"}, ...}, arrays.
class File {
 public:
  explicit File(const std::string& path) {
    std::ifstream stream(path, std::ios::binary | std::ios::ate);
    const std::streamoff size = stream ? std::streamoff(stream.tellg()) : -1;
    if (size < 0) throw Error(path + " cannot be read");
    content_.resize(std::size_t(size));
    if (!stream.seekg(0) || !stream.read(content_.data(), size)) throw Error(path + " cannot be read");
    std::uint64_t length = 0;
    if (size < 8) fail("is truncated");
    std::memcpy(&length, content_.data(), 8);
    if (length > std::uint64_t(size) - 8) fail("is truncated");
    at_ = content_.data() + 8, end_ = data_ = at_ + length;
    available_ = std::size_t(size) - 8 - std::size_t(length);
    read_header();
    if (metadata("format") != "dpl runtime 3") fail("has another format than dpl runtime 3; export the run again");
    const std::string stored = metadata("crc32"), key = "\"crc32\":\"";
    const auto place = std::search(content_.begin(), content_.begin() + 8 + std::ptrdiff_t(length), key.begin(), key.end());
    if (stored.size() != 8 || content_.end() - place < 24) fail("is damaged: it has no checksum");
    std::fill_n(place + std::ptrdiff_t(key.size()), 8, '0');  // as the checksum was made
    if (stored != checksum()) fail("is damaged: its checksum differs");
  }
  const std::string& metadata(const std::string& key) const {
    const auto found = metadata_.find(key);
    if (found == metadata_.end()) fail("has no " + key);
    return found->second;
  }
  bool has(const std::string& name) const { return entries_.count(name) > 0; }
  std::vector<std::string> patches() const {
    std::vector<std::string> names;
    for (const auto& [name, entry] : entries_)
      if (name.size() > 12 && name.compare(0, 6, "patch.") == 0 && name.compare(name.size() - 6, 6, ".nodes") == 0)
        names.push_back(name.substr(6, name.size() - 12));
    return names;
  }
  void forget(char letter) { sizes_.erase(letter); }
  // Size that a letter of a shape stands for. A shape such as "N3" has letters and digits.
  std::size_t size(char letter) const { return sizes_.at(letter); }
  bool is_float32(const std::string& name) const { return entry(name).dtype == "F32"; }
  template <class T> std::vector<T> read(const std::string& name, const std::string& shape) {
    const Entry& found = entry(name);
    const char* dtype = std::is_same<T, double>::value ? "F64" : std::is_same<T, float>::value ? "F32"
                        : std::is_same<T, std::int32_t>::value ? "I32" : std::is_same<T, std::int64_t>::value ? "I64"
                        : std::is_same<T, std::int16_t>::value ? "I16" : "U8";
    if (found.dtype != dtype || found.shape.size() != shape.size()) fail(name + " has another type");
    std::size_t count = 1;
    for (std::size_t k = 0; k < shape.size(); ++k) {
      const std::size_t length = found.shape[k], digit = std::size_t(shape[k] - '0');
      const std::size_t wanted = digit < 10 ? digit : sizes_.emplace(shape[k], length).first->second;
      if (length != wanted) fail(name + " has another shape");
      if (length && count > available_ / length) fail(name + " is truncated");
      count *= length;
    }
    if (count > available_ || count * sizeof(T) != found.end - found.begin) fail(name + " has another size");
    std::vector<T> values(count);
    if (count) std::memcpy(values.data(), data_ + found.begin, count * sizeof(T));
    if constexpr (std::is_floating_point<T>::value)
      for (T x : values)
        if (!std::isfinite(x)) fail(name + " is not finite");
    return values;
  }
  template <class T> std::vector<T> indices(const std::string& name, const std::string& shape, std::size_t limit) {
    std::vector<T> values = read<T>(name, shape);
    for (T x : values)
      if (x < 0 || std::uint64_t(x) >= limit) fail(name + " is out of range");
    return values;
  }
  double number(const std::string& name) { return read<double>(name, "1")[0]; }
  double positive(const std::string& name) {
    const double value = number(name);
    if (!(value > 0)) fail(name + " must be above 0");
    return value;
  }
  void check(bool valid, const char* name) const {
    if (!valid) fail(std::string(name) + " is invalid");
  }
  [[noreturn]] static void fail(const std::string& words) { throw Error("runtime file " + words); }

 private:
  struct Entry {
    std::string dtype;
    std::vector<std::size_t> shape;
    std::size_t begin = 0, end = 0;
  };
  const Entry& entry(const std::string& name) const {
    const auto found = entries_.find(name);
    if (found == entries_.end()) fail("has no " + name);
    return found->second;
  }
  char peek() {
    while (at_ < end_ && (*at_ == ' ' || *at_ == '\n' || *at_ == '\r' || *at_ == '\t')) ++at_;
    if (at_ == end_) fail("has a damaged header");
    return *at_;
  }
  bool follows(char wanted) {
    if (peek() != wanted) return false;
    ++at_;
    return true;
  }
  void expect(char wanted) {
    if (!follows(wanted)) fail("has a damaged header");
  }
  std::string text() {
    std::string found;
    for (expect('"'); at_ < end_ && *at_ != '"'; ++at_) {
      if (*at_ == '\\') fail("has a damaged header");  // names and values need no escapes
      found += *at_;
    }
    expect('"');
    return found;
  }
  std::size_t whole() {
    if (peek() < '0' || *at_ > '9') fail("has a damaged header");
    std::uint64_t value = 0;
    for (; at_ < end_ && *at_ >= '0' && *at_ <= '9'; ++at_) {
      value = 10 * value + std::uint64_t(*at_ - '0');
      if (value > (std::uint64_t(1) << 48)) fail("has a damaged header");
    }
    return std::size_t(value);
  }
  std::vector<std::size_t> wholes() {
    std::vector<std::size_t> found;
    expect('[');
    if (follows(']')) return found;
    do found.push_back(whole());
    while (follows(','));
    expect(']');
    return found;
  }
  void read_header() {
    expect('{');
    do {
      const std::string name = text();
      expect(':');
      expect('{');
      if (name == "__metadata__") {
        do {
          const std::string key = text();
          expect(':');
          metadata_[key] = text();
        } while (follows(','));
      } else {
        Entry entry;
        std::vector<std::size_t> ends;
        do {
          const std::string key = text();
          expect(':');
          if (key == "dtype") entry.dtype = text();
          else if (key == "shape") entry.shape = wholes();
          else if (key == "data_offsets") ends = wholes();
          else fail("has a damaged header");
        } while (follows(','));
        if (ends.size() != 2 || ends[0] > ends[1] || ends[1] > available_) fail("is truncated");
        entry.begin = ends[0], entry.end = ends[1];
        entries_[name] = entry;
      }
      expect('}');
    } while (follows(','));
    expect('}');
  }
  std::string checksum() const {  // CRC-32 in hexadecimal
    std::uint32_t table[256], crc = 0xffffffffu;
    for (std::uint32_t n = 0; n < 256; ++n) {
      table[n] = n;
      for (int k = 0; k < 8; ++k) table[n] = (table[n] >> 1) ^ (table[n] & 1 ? 0xedb88320u : 0u);
    }
    for (char x : content_) crc = table[(crc ^ std::uint8_t(x)) & 255] ^ (crc >> 8);
    char text[9];
    std::snprintf(text, sizeof text, "%08x", unsigned(~crc));
    return text;
  }
  std::vector<char> content_;
  const char *at_ = nullptr, *end_ = nullptr, *data_ = nullptr;
  std::size_t available_ = 0;
  std::map<std::string, Entry> entries_;
  std::map<std::string, std::string> metadata_;
  std::map<char, std::size_t> sizes_;
};

// ---------------------------------------------------------------- K(0)^-1 by static condensation
constexpr int ROWS = 4, LANES = 16;  // of a tile, see dpl.fem.linear.tiles; -O2 does not unroll loops over rows
inline std::int64_t high(std::int64_t count) { return (count + ROWS - 1) / ROWS * ROWS; }
inline std::int64_t wide(std::int64_t count) { return (count + LANES - 1) / LANES * LANES; }
template <class T, class Number>
inline void add_tiles(const T* x, const Number* tile, std::int64_t rows, std::int64_t n, T* y) {  // y += x A
  constexpr int lanes = sizeof(Sums<T>) / sizeof(T);
  for (std::int64_t i = 0; i < rows; i += ROWS)
    for (std::int64_t j = 0; j < n; j += LANES, tile += ROWS * LANES)
      for (int l = 0; l < LANES; l += lanes) {
        const Number *p = tile + l, *q = p + LANES, *r = q + LANES, *s = r + LANES;
        store(y + j + l, load_as<T>(y + j + l) + (x[i] * load_as<T>(p) + x[i + 1] * load_as<T>(q)) +
                             (x[i + 2] * load_as<T>(r) + x[i + 3] * load_as<T>(s)));
      }
}
template <class T, class Number>
inline void subtract_tiles(const Number* tile, const T* x, std::int64_t rows, std::int64_t n, T* y) {  // y -= A x
  constexpr int lanes = sizeof(Sums<T>) / sizeof(T);
  for (std::int64_t i = 0; i < rows; i += ROWS) {
    Sums<T> a = {}, b = {}, c = {}, d = {};
    for (std::int64_t j = 0; j < n; j += LANES, tile += ROWS * LANES)
      for (int l = 0; l < LANES; l += lanes) {
        const Number *p = tile + l, *q = p + LANES, *r = q + LANES, *s = r + LANES;
        const Sums<T> v = load_as<T>(x + j + l);
        a += v * load_as<T>(p), b += v * load_as<T>(q), c += v * load_as<T>(r), d += v * load_as<T>(s);
      }
    y[i] -= sum<T>(a), y[i + 1] -= sum<T>(b), y[i + 2] -= sum<T>(c), y[i + 3] -= sum<T>(d);
  }
}

struct Condensed {  // dpl.fem.linear.condensation; one matrix for each of M parities
  std::vector<std::int64_t> table;  // (S, 4)
  std::vector<std::int32_t> order;  // (n,)
  std::vector<std::int32_t> unknowns;  // (T,)
  std::vector<std::int16_t> values;    // (M, V), times
  std::vector<float> factors;          // of rows and columns (M, 3, T), or
  Doubles exact, exact_factors;        // where 16 bits lose too much
  std::size_t length = 0;              // V
  int most = 0;                        // largest length of the rows of a front

  template <class Number, class T>
  void solve(const Number* blocks, const T* of_inverse, const T* forces, T* solutions, std::vector<T>& work) const {
    const T *of_coupling = of_inverse + unknowns.size(), *columns = of_coupling + unknowns.size();
    const std::size_t n = order.size();
    work.resize(2 * (n + std::size_t(most)));
    T *force = work.data(), *solution = force + n, *own = solution + n, *other = own + most;
    for (std::size_t i = 0; i < n; ++i) force[i] = forces[order[i]];
    const int fronts = int(table.size() / 4);
    std::int64_t pivot = 0;  // first one of a front
    for (int s = 0; s < fronts; ++s) {
      const std::int64_t *row = table.data() + 4 * s, first = row[0], count = row[1] - first;
      const T* acting = force + pivot;
      T* found = solution + pivot;
      pivot += count;
      std::fill(found, found + count, T(0));
      if (std::all_of(acting, acting + count, [](T x) { return x == 0; })) continue;
      const Number* block = blocks + row[3];
      for (int k = 0; k < 2; ++k) {  // F_II^-1 f, X^T f
        const T* rows = (k ? of_coupling : of_inverse) + first;
        const std::int64_t begin = row[k], length = row[k + 1] - begin;
        for (std::int64_t i = 0; i < count; ++i) own[i] = rows[i] * acting[i];
        std::fill(own + count, own + high(count), T(0)), std::fill(other, other + wide(length), T(0));
        add_tiles(own, block, high(count), wide(length), other);
        const std::int32_t* places = unknowns.data() + begin;
        if (k) for (std::int64_t j = 0; j < length; ++j) force[places[j]] -= columns[begin + j] * other[j];
        else for (std::int64_t j = 0; j < length; ++j) found[j] = columns[begin + j] * other[j];
        block += high(count) * wide(length);
      }
    }
    for (int s = fronts - 1; s >= 0; --s) {
      const std::int64_t *row = table.data() + 4 * s, first = row[0], count = row[1] - first, length = row[2] - row[1];
      const std::int32_t* places = unknowns.data() + row[1];
      std::fill(own, own + high(count), T(0)), std::fill(other, other + wide(length), T(0));
      for (std::int64_t j = 0; j < length; ++j) other[j] = columns[row[1] + j] * solution[places[j]];
      subtract_tiles(blocks + row[3] + high(count) * wide(count), other, high(count), wide(length), own);
      pivot -= count;
      for (std::int64_t i = 0; i < count; ++i) solution[pivot + i] += of_coupling[first + i] * own[i];
    }
    for (std::size_t i = 0; i < n; ++i) solutions[order[i]] = solution[i];
  }
};

// Eigenvalues on the diagonal of A (n, n), which is overwritten, and eigenvectors as columns of Q.
inline void jacobi(std::vector<double>& A, std::vector<double>& Q, int n) {
  Q.assign(std::size_t(n) * n, 0.0);
  for (int i = 0; i < n; ++i) Q[i * n + i] = 1;
  for (int sweep = 0; sweep < 30; ++sweep) {
    double off = 0, diagonal = 0;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) (i == j ? diagonal : off) += A[i * n + j] * A[i * n + j];
    if (!(off > 1e-32 * diagonal)) return;
    for (int p = 0; p < n; ++p)
      for (int q = p + 1; q < n; ++q) {
        if (A[p * n + q] == 0) continue;
        const double theta = (A[q * n + q] - A[p * n + p]) / (2 * A[p * n + q]);
        const double t = (theta < 0 ? -1 : 1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (int k = 0; k < n; ++k) {
          const double x = A[k * n + p], y = A[k * n + q], v = Q[k * n + p], w = Q[k * n + q];
          A[k * n + p] = c * x - s * y, A[k * n + q] = s * x + c * y;
          Q[k * n + p] = c * v - s * w, Q[k * n + q] = s * v + c * w;
        }
        for (int k = 0; k < n; ++k) {
          const double x = A[p * n + k], y = A[q * n + k];
          A[p * n + k] = c * x - s * y, A[q * n + k] = s * x + c * y;
        }
      }
  }
}

}  // namespace detail

// Estimated relative error [-] under a load in range: factor prod_k max(size_k, least_k)^exponent_k.
inline double estimated_error(double factor, const std::vector<double>& exponents, const std::vector<double>& least,
                              const std::vector<double>& sizes) {
  double logarithm = 0;
  for (std::size_t k = 0; k < sizes.size(); ++k) logarithm += exponents[k] * std::log(std::max(sizes[k], least[k]));
  return factor * std::exp(logarithm);
}

class Simulator {
 public:
  double young = 0;  // Young's modulus [Pa]; that of the export unless it is changed

  // Read a file that `scripts/export.py outputs=[runtime]` wrote; throws Error.
  static Simulator open(const std::string& path) {
    detail::File file(path);
    Simulator sim;
    sim.read(file);
    return sim;
  }
  int nodes() const { return int(free_.size() / 3); }
  const std::vector<double>& points() const { return points_; }                    // (N, 3) [m]
  const std::vector<std::int32_t>& surface() const { return surface_; }            // its nodes, (S,)
  const std::vector<std::int32_t>& triangles() const { return triangles_; }        // nodes, (T, 3)
  const std::map<std::string, Patch>& patches() const { return patches_; }

  // Add a total force [N] on a patch to nodal forces (N, 3) [N].
  static void add_force(const Patch& patch, const std::array<double, 3>& total, double* force) {
    for (std::size_t k = 0; k < patch.nodes.size(); ++k)
      for (int i = 0; i < 3; ++i) force[3 * patch.nodes[k] + i] += patch.weights[k] * total[i];
  }
  // Nodes of the surface within a distance [m] of a point [m], or the nearest one, loaded equally.
  Patch patch_around(const std::array<double, 3>& centre, double radius) const {
    Patch patch;
    double least = std::numeric_limits<double>::infinity();
    int nearest = 0;
    for (int node : surface_) {
      double square = 0;
      for (int i = 0; i < 3; ++i) square += std::pow(points_[3 * node + i] - centre[i], 2);
      if (square < least) least = square, nearest = node;
      if (square <= radius * radius) patch.nodes.push_back(node);
    }
    if (patch.nodes.empty()) patch.nodes.push_back(nearest);
    patch.weights.assign(patch.nodes.size(), 1.0 / double(patch.nodes.size()));
    return patch;
  }
  // Answer a total force [N] on a named patch; throws Error.
  const Answer& solve(const std::string& patch, const std::array<double, 3>& total) {
    const auto found = patches_.find(patch);
    if (found == patches_.end()) throw Error("patch = " + patch + " does not exist");
    patch_force_.assign(free_.size(), 0.0);
    add_force(found->second, total, patch_force_.data());
    return solve(patch_force_.data());
  }
  // Answer nodal forces (N, 3) [N]; the result is valid until the next call. Throws Error.
  const Answer& solve(const double* force) {
    const double scale = 1 / (young * force_unit_);
    for (std::size_t k = 0; k < load_.size(); ++k) {
      if (!std::isfinite(force[k])) throw Error("force must be finite");
      load_[k] = free_[k] ? force[k] * scale : 0.0;
    }
    predict();
    std::fill(internal_.begin(), internal_.end(), 0.0);
    answer_.min_det_F = 1 + internal_force_(cells_, u_.data(), internal_.data());
    for (std::size_t k = 0; k < load_.size(); ++k) {
      residual_[k] = free_[k] ? load_[k] - internal_[k] : 0.0;
      answer_.displacement[k] = length_ * u_[k];
      if (is_moved_) reactions_[k] = prescribed_[k] != 0 ? internal_[k] : 0.0;
    }
    const double size = std::max(detail::norm(load_), is_moved_ ? detail::norm(reactions_) : 0.0);
    answer_.residual = detail::norm(residual_) / (size > 0 ? size : 1);
    find_range();
    answer_.error = error();
    return answer_;
  }

 private:
  using Doubles = std::vector<double>;

  void read(detail::File& file) {
    using std::int32_t;
    law_ = detail::law_named(file.metadata("law"));
    length_ = file.positive("length"), force_unit_ = file.positive("force_unit"), young = file.positive("young");
    characters_ = file.read<double>("characters", "MM"), signs_ = file.read<double>("signs", "Mm");
    scales_ = file.read<double>("scales", "Mm"), supports_ = file.read<double>("supports", "Mm");
    free_ = file.read<std::uint8_t>("free", "N3");
    dofs_ = file.indices<int32_t>("dofs", "Mm", free_.size());
    points_ = file.read<double>("points", "N3"), prescribed_ = file.read<double>("prescribed", "N3");
    reduced_ = file.read<double>("reduced_inverse", "RR");
    columns_ = file.indices<int32_t>("columns", "Mr", file.size('R') + 1);
    modes_ = file.read<float>("modes", "Mrm"), gradients_ = file.read<float>("gradients", "Mrb");
    rest_ = file.read<double>("rest", "Mb"), entry_signs_ = file.read<double>("entry_signs", "Mb");
    first_signs_ = file.read<double>("first_signs", "Mb"), map_signs_ = file.read<double>("map_signs", "Md");
    first_ = file.read<float>("first_map", "Mrb"), maps_ = file.read<float>("maps", "KMrd");
    limits_ = file.read<double>("limits", "l");
    M_ = int(file.size('M')), m_ = int(file.size('m')), R_ = int(file.size('R')), r_ = int(file.size('r'));
    b_ = int(file.size('b')), K_ = int(file.size('K'));
    file.check(file.size('l') == file.size('K') + 1, "limits");
    file.check(file.size('d') == 2 * file.size('b') && b_ % (9 * detail::L) == 0, "map_signs");
    condensed_.table = file.read<std::int64_t>("front_table", "S4");
    condensed_.order = file.indices<int32_t>("front_order", "m", file.size('m'));
    condensed_.unknowns = file.indices<int32_t>("front_unknowns", "T", file.size('m'));
    if (file.is_float32("block_factors")) {
      condensed_.values = file.read<std::int16_t>("blocks", "MV"), condensed_.factors = file.read<float>("block_factors", "M3T");
    } else {
      condensed_.exact = file.read<double>("blocks", "MV"), condensed_.exact_factors = file.read<double>("block_factors", "M3T");
    }
    condensed_.length = file.size('V');
    const std::int64_t T = std::int64_t(file.size('T')), V = std::int64_t(file.size('V'));
    std::int64_t pivots = 0;
    for (std::size_t s = 0; s < file.size('S'); ++s) {
      const std::int64_t* row = condensed_.table.data() + 4 * s;
      file.check(0 <= row[0] && row[0] <= row[1] && row[1] <= row[2] && row[2] <= T, "front_table");
      const std::int64_t count = row[1] - row[0], width = detail::wide(count) + detail::wide(row[2] - row[1]);
      file.check(0 <= row[3] && row[3] <= V && (width == 0 || detail::high(count) <= (V - row[3]) / width), "front_table");
      pivots += count;
      condensed_.most = std::max(condensed_.most, int(width));
    }
    file.check(pivots == m_, "front_table");
    error_factor_ = file.number("error_factor"), error_exponents_ = file.read<double>("error_exponents", "e");
    least_sizes_ = file.read<double>("least_sizes", "e");
    file.check(file.size('e') == file.size('K') + 2, "error_exponents");
    read_cells(file);
    read_loads(file);
    surface_ = file.indices<int32_t>("surface", "s", file.size('N'));
    triangles_ = file.indices<int32_t>("triangles", "t3", file.size('N'));
    for (const std::string& name : file.patches()) {
      Patch patch;
      patch.nodes = file.indices<int32_t>("patch." + name + ".nodes", "*", file.size('N'));
      patch.weights = file.read<double>("patch." + name + ".weights", "*");
      file.forget('*');
      patches_[name] = patch;
    }
    allocate();
  }

  // Arrange values (count or 1, rows) of cells in blocks of L lanes.
  static Doubles in_lanes(const Doubles& values, std::size_t rows, std::size_t count, std::size_t blocks) {
    Doubles lanes(rows * detail::L * blocks);
    for (std::size_t block = 0; block < blocks; ++block)
      for (std::size_t l = 0; l < detail::L; ++l) {
        const std::size_t cell = std::min(block * detail::L + l, count - 1);
        for (std::size_t r = 0; r < rows; ++r) lanes[(block * rows + r) * detail::L + l] = values[cell * rows + r];
      }
    return lanes;
  }
  void read_cells(detail::File& file) {
    using detail::L;
    const std::vector<std::int32_t> nodes = file.indices<std::int32_t>("cells", "EA", file.size('N'));
    const Doubles dN = file.read<double>("dN", "gQA3"), dV = file.read<double>("dV", "gQ");
    const Doubles law = file.read<double>("law_cells", "hc"), samples = file.read<double>("law_samples", "iC");
    const std::size_t E = file.size('E'), A = file.size('A'), Q = file.size('Q'), shapes = file.size('g');
    file.check(E > 0 && A > 0 && A <= detail::MOST_NODES && Q > 0, "cells");
    file.check(shapes == 1 || shapes == E, "dN");
    file.check(file.size('c') == std::size_t(law_.constants) && (file.size('h') == 1 || file.size('h') == E), "law_cells");
    file.check(M_ > 0 && b_ > 0, "gradients");
    const std::size_t C = std::size_t(law_.constants) + 2, lanes = std::size_t(M_) * std::size_t(b_) / 9;
    file.check(file.size('C') == C && (file.size('i') == 1 || file.size('i') == lanes), "law_samples");
    cells_.count = int(E), cells_.nodes = int(A), cells_.points = int(Q), cells_.blocks = int((E + L - 1) / L);
    cells_.dofs.resize(std::size_t(cells_.blocks) * A * L);
    for (std::size_t block = 0; block < std::size_t(cells_.blocks); ++block)
      for (std::size_t a = 0; a < A; ++a)
        for (std::size_t l = 0; l < L; ++l)
          cells_.dofs[(block * A + a) * L + l] = 3 * nodes[std::min(block * L + l, E - 1) * A + a];
    const std::size_t blocks = std::size_t(cells_.blocks);
    cells_.shape_step = shapes > 1 ? L : 0, cells_.law_step = file.size('h') > 1 ? std::size_t(law_.constants) * L : 0;
    cells_.dN = in_lanes(dN, Q * A * 3, shapes, shapes > 1 ? blocks : 1);
    cells_.dV = in_lanes(dV, Q, shapes, shapes > 1 ? blocks : 1);
    cells_.law = in_lanes(law, std::size_t(law_.constants), file.size('h'), cells_.law_step ? blocks : 1);
    sample_law_step_ = file.size('i') > 1 ? C * L : 0;
    sample_law_ = in_lanes(samples, C, file.size('i'), sample_law_step_ ? lanes / L : 1);
    Doubles integrals(shapes * A * 3);
    for (std::size_t e = 0; e < shapes; ++e)
      for (std::size_t q = 0; q < Q; ++q)
        for (std::size_t r = 0; r < A * 3; ++r) integrals[e * A * 3 + r] += dV[e * Q + q] * dN[(e * Q + q) * A * 3 + r];
    cells_.integrals = in_lanes(integrals, A * 3, shapes, shapes > 1 ? blocks : 1);
    internal_force_ = A == 8 ? law_.force_of_hexahedra : law_.force;
    volumes_.assign(file.size('N'), 0.0);
    for (std::size_t e = 0; e < E; ++e)
      for (std::size_t a = 0; a < A; ++a)
        for (std::size_t q = 0; q < Q; ++q) volumes_[std::size_t(nodes[e * A + a])] += dV[(shapes > 1 ? e : 0) * Q + q];
  }
  void read_loads(detail::File& file) {
    family_ = file.metadata("loads");
    largest_force_ = file.positive("largest_force");
    constant_force_ = file.read<double>("constant_force", "N3");
    loadable_ = file.read<std::uint8_t>("loadable", "N3");
    if (family_ == "other") return;
    load_nodes_ = file.indices<std::int32_t>("load_nodes", "n", file.size('N'));
    shapes_ = file.read<double>("load_shapes", "n3P"), span_ = file.read<double>("load_span", "5");
    P_ = int(file.size('P'));
    file.check(P_ > 0 && span_[4] > 0, "load_span");
    shape_of_node_.assign(file.size('N'), -1);
    for (std::size_t k = 0; k < load_nodes_.size(); ++k) shape_of_node_[std::size_t(load_nodes_[k])] = int(k);
    rest_force_.assign(3 * load_nodes_.size(), 0.0), rows_.assign(3 * load_nodes_.size() * std::size_t(P_), 0.0);
  }
  void allocate() {
    const std::size_t n = free_.size(), M = std::size_t(M_), m = std::size_t(m_), b = std::size_t(b_);
    for (Doubles* field : {&load_, &internal_, &residual_, &reactions_, &own_force_, &answer_.displacement}) field->assign(n, 0.0);
    u_ = prescribed_;
    is_moved_ = std::any_of(u_.begin(), u_.end(), [](double x) { return x != 0; });
    for (Doubles* parts : {&parts_, &forces_, &solution_}) parts->assign(M * m, 0.0);
    for (Doubles* parts : {&linear_gradients_, &present_, &features_}) parts->assign(M * b, 0.0);
    stress_.assign(2 * M * b, 0.0), split_.assign(2 * M * b, 0.0), own_.assign(std::size_t(r_), 0.0);
    for (Doubles* c : {&linear_, &total_, &step_, &sum_}) c->assign(std::size_t(R_), 0.0);
    answer_.sizes.assign(std::size_t(K_) + 2, 0.0);
    q_.assign(std::size_t(P_), 0.0), right_ = wanted_ = scratch_ = q_, gram_.assign(std::size_t(P_) * P_, 0.0), axes_ = values_ = gram_;
  }

  // ---------------------------------------------------------------- prediction, by parity
  void set_parts(const Doubles& field) {
    std::fill(parts_.begin(), parts_.end(), 0.0);
    for (int g = 0; g < M_; ++g) {
      const double* scale = scales_.data() + std::size_t(g) * m_;
      const std::int32_t* dofs = dofs_.data() + std::size_t(g) * m_;
      double* image = forces_.data();
      for (int j = 0; j < m_; ++j) image[j] = scale[j] * field[std::size_t(dofs[j])];
      for (int p = 0; p < M_; ++p) {
        double* part = parts_.data() + std::size_t(p) * m_;
        const double factor = characters_[std::size_t(p * M_ + g)];
        for (int j = 0; j < m_; ++j) part[j] += factor * image[j];
      }
    }
  }
  template <class Number, class T>
  void solve_at_rest(const Number* blocks, const T* factors, std::vector<T>& force, std::vector<T>& solution, std::vector<T>& work) {
    double unit = 0;  // over which float32 holds the forces
    for (double x : parts_) unit = std::max(unit, std::abs(x));
    if (!(unit > 0)) unit = 1;
    force.resize(parts_.size()), solution.resize(parts_.size());
    for (std::size_t k = 0; k < parts_.size(); ++k) force[k] = T(parts_[k] / unit);
    for (std::size_t p = 0; p < std::size_t(M_); ++p) {
      T *own = force.data() + p * m_, *found = solution.data() + p * m_;
      if (std::all_of(own, own + m_, [](T x) { return x == 0; })) std::fill(found, found + m_, T(0));
      else condensed_.solve(blocks + p * condensed_.length, factors + 3 * p * condensed_.unknowns.size(), own, found, work);
    }
    for (std::size_t k = 0; k < parts_.size(); ++k) solution_[k] = unit * double(solution[k]);
  }
  void solve_at_rest() {  // set solution_ to that of parts_
    if (condensed_.exact.empty()) solve_at_rest(condensed_.values.data(), condensed_.factors.data(), float_forces_, float_solution_, float_work_);
    else solve_at_rest(condensed_.exact.data(), condensed_.exact_factors.data(), forces_, exact_solution_, condensed_work_);
  }
  void set_own(int p, const Doubles& coordinates) {
    for (int k = 0; k < r_; ++k) {
      const int column = columns_[std::size_t(p * r_ + k)];
      own_[std::size_t(k)] = column < R_ ? coordinates[std::size_t(column)] : 0.0;
    }
  }
  void set_gradients(const Doubles& coordinates, Doubles& H) {
    std::fill(split_.begin(), split_.begin() + std::ptrdiff_t(M_) * b_, 0.0);
    for (int p = 0; p < M_; ++p) {
      set_own(p, coordinates);
      detail::add_product(own_.data(), gradients_.data() + std::size_t(p) * r_ * b_, r_, b_, split_.data() + std::size_t(p) * b_);
    }
    H = rest_;
    for (int g = 0; g < M_; ++g)
      for (int p = 0; p < M_; ++p) {
        const double factor = characters_[std::size_t(g * M_ + p)];
        const double *sign = entry_signs_.data() + std::size_t(g) * b_, *part = split_.data() + std::size_t(p) * b_;
        double* image = H.data() + std::size_t(g) * b_;
        for (int j = 0; j < b_; ++j) image[j] += factor * sign[j] * part[j];
      }
  }
  // Set step_ to the product of matrices (M, r, n) with features (M, n); return its limited norm.
  double set_step(const Doubles& features, const Doubles& signs, const float* matrices, int n, double most) {
    for (int p = 0; p < M_; ++p) {
      std::fill(split_.begin(), split_.begin() + n, 0.0);
      for (int g = 0; g < M_; ++g) {
        const double factor = characters_[std::size_t(p * M_ + g)];
        const double *sign = signs.data() + std::size_t(g) * n, *image = features.data() + std::size_t(g) * n;
        for (int j = 0; j < n; ++j) split_[std::size_t(j)] += factor * sign[j] * image[j];
      }
      std::fill(own_.begin(), own_.end(), 0.0);
      detail::subtract_product(matrices + std::size_t(p) * r_ * n, split_.data(), r_, n, own_.data());
      for (int k = 0; k < r_; ++k) {
        const int column = columns_[std::size_t(p * r_ + k)];
        if (column < R_) step_[std::size_t(column)] = -own_[std::size_t(k)];
      }
    }
    const double size = detail::norm(step_);
    if (!(size > most)) return size;
    for (double& x : step_) x *= most / size;
    return most;
  }
  void predict() {
    set_parts(load_);
    for (std::size_t k = 0; k < parts_.size(); ++k) parts_[k] -= supports_[k];
    std::fill(sum_.begin(), sum_.end(), 0.0);
    for (int p = 0; p < M_; ++p)
      for (int k = 0; k < r_; ++k) {
        const int column = columns_[std::size_t(p * r_ + k)];
        const std::size_t row = std::size_t(p) * r_ + k;
        if (column < R_) sum_[std::size_t(column)] += detail::dot(parts_.data() + std::size_t(p) * m_, modes_.data() + row * m_, m_);
      }
    for (int i = 0; i < R_; ++i) linear_[std::size_t(i)] = detail::dot(sum_.data(), reduced_.data() + std::size_t(i) * R_, R_);
    solve_at_rest();
    set_coordinates();
    for (int p = 0; p < M_; ++p) {
      set_own(p, total_);
      detail::add_product(own_.data(), modes_.data() + std::size_t(p) * r_ * m_, r_, m_, solution_.data() + std::size_t(p) * m_);
    }
    set_field();
  }
  void set_coordinates() {  // loops.nonlinear_coordinates
    using detail::L;
    const int blocks = M_ * b_ / (9 * L);
    set_gradients(linear_, linear_gradients_);
    for (int k = 0; k < blocks; ++k) detail::rotated_strain(linear_gradients_.data() + 9 * L * k, features_.data() + 9 * L * k);
    double size = answer_.sizes[0] = detail::norm(linear_);
    size = answer_.sizes[1] = set_step(features_, first_signs_, first_.data(), b_, limits_[0] * size);
    total_ = step_;
    for (int i = 0; i < K_; ++i) {
      for (int k = 0; k < R_; ++k) sum_[std::size_t(k)] = linear_[std::size_t(k)] + total_[std::size_t(k)];
      set_gradients(sum_, present_);
      for (int k = 0; k < blocks; ++k)
        law_.stress(sample_law_.data() + std::size_t(k) * sample_law_step_, present_.data() + 9 * L * k,
                    linear_gradients_.data() + 9 * L * k, stress_.data() + 18 * L * k);
      const float* map = maps_.data() + std::size_t(i) * M_ * 2 * b_ * r_;
      size = set_step(stress_, map_signs_, map, 2 * b_, limits_[std::size_t(i) + 1] * size);
      answer_.sizes[std::size_t(i) + 2] = size;
      for (int k = 0; k < R_; ++k) total_[std::size_t(k)] += step_[std::size_t(k)];
    }
  }
  void set_field() {  // u at free degrees of freedom of solution_
    for (int g = 0; g < M_; ++g) {
      double* image = forces_.data();
      std::fill(image, image + m_, 0.0);
      for (int p = 0; p < M_; ++p) {
        const double factor = characters_[std::size_t(g * M_ + p)], *part = solution_.data() + std::size_t(p) * m_;
        for (int j = 0; j < m_; ++j) image[j] += factor * part[j];
      }
      const std::size_t first = std::size_t(g) * m_;
      for (int j = 0; j < m_; ++j) u_[std::size_t(dofs_[first + j])] = signs_[first + j] * image[j];
    }
  }

  // ---------------------------------------------------------------- range: LoadFamily.project
  void find_range() {
    answer_.amplitude = 0, answer_.out_of_span = 0, answer_.range = Range::inside;
    double foreign = 0, unit = 0;
    for (std::size_t k = 0; k < load_.size(); ++k) {
      own_force_[k] = free_[k] ? load_[k] - constant_force_[k] : 0.0;
      unit = std::max(unit, std::abs(own_force_[k]));
    }
    if (unit > 0 && family_ == "other") {
      for (std::size_t k = 0; k < load_.size(); ++k) foreign += loadable_[k] ? 0.0 : own_force_[k] / unit * (own_force_[k] / unit);
      const double size = detail::norm(own_force_);
      answer_.amplitude = size / largest_force_, answer_.out_of_span = unit * std::sqrt(foreign) / size;
    } else if (unit > 0) {
      fit(unit);
    }
    const bool is_outside = answer_.amplitude > 1 + 1e-9 || answer_.out_of_span > 1e-3;
    if (is_outside) answer_.range = Range::outside;
    else if (family_ == "other") answer_.range = Range::unknown, answer_.out_of_span = std::numeric_limits<double>::quiet_NaN();
  }
  void fit(double unit) {  // dpl.fem.loads.fit
    const int n = P_;
    double foreign = 0, square = 0;
    for (std::size_t k = 0; k < own_force_.size(); ++k) {
      const double f = own_force_[k] / unit;
      square += f * f;
      if (shape_of_node_[k / 3] < 0) foreign += f * f;
    }
    int count = 0;  // rows of the fit
    for (std::size_t k = 0; k < load_nodes_.size(); ++k) {
      const double* f = own_force_.data() + 3 * load_nodes_[k];
      if (family_ == "modal" && f[0] == 0 && f[1] == 0 && f[2] == 0) continue;  // fitted where a force acts
      for (int i = 0; i < 3; ++i, ++count) {
        rest_force_[std::size_t(count)] = f[i] / unit;
        for (int p = 0; p < n; ++p) rows_[std::size_t(p) * rest_force_.size() + std::size_t(count)] = shapes_[(k * 3 + std::size_t(i)) * std::size_t(n) + std::size_t(p)];
      }
    }
    const auto row = [&](int p) { return rows_.data() + std::size_t(p) * rest_force_.size(); };
    for (int k = 0; k < n; ++k)
      for (int j = 0; j <= k; ++j)
        gram_[std::size_t(k * n + j)] = gram_[std::size_t(j * n + k)] = detail::dot(row(k), row(j), count);
    values_ = gram_;
    detail::jacobi(values_, axes_, n);
    double largest = 0;
    for (int k = 0; k < n; ++k) largest = std::max(largest, values_[std::size_t(k * n + k)]);
    bool is_dependent = false;
    std::fill(q_.begin(), q_.end(), 0.0);
    for (int pass = 0; pass < 2; ++pass) {  // the second removes the rounding error of the first
      for (int k = 0; k < n; ++k) right_[std::size_t(k)] = detail::dot(rest_force_.data(), row(k), count);
      std::fill(scratch_.begin(), scratch_.end(), 0.0);
      for (int k = 0; k < n; ++k) {
        double along = 0;
        for (int j = 0; j < n; ++j) along += axes_[std::size_t(j * n + k)] * right_[std::size_t(j)];
        const double value = values_[std::size_t(k * n + k)];
        if (!(value > 1e-13 * largest)) is_dependent = true;
        else
          for (int j = 0; j < n; ++j) scratch_[std::size_t(j)] += axes_[std::size_t(j * n + k)] * (along / value);
      }
      for (int k = 0; k < n; ++k) {
        q_[std::size_t(k)] += scratch_[std::size_t(k)];
        const double step = scratch_[std::size_t(k)], *shape = row(k);
        for (int j = 0; j < count; ++j) rest_force_[std::size_t(j)] -= step * shape[j];
      }
    }
    const double left = foreign + detail::dot(rest_force_.data(), rest_force_.data(), count);
    for (double& x : q_) x *= unit;
    answer_.out_of_span = std::sqrt(left / square);
    if (is_dependent) move_into_bounds();
    const double low = span_[2], high = span_[3], most = span_[4];
    const auto amplitude = [&](double size) {
      const double distance = std::max(low - size, size - high);
      return distance > 1e-6 * most ? 1 + distance / most : std::abs(size) / most;
    };
    if (family_ == "vector") answer_.amplitude = amplitude(detail::norm(q_));
    else
      for (double x : q_) answer_.amplitude = std::max(answer_.amplitude, amplitude(x));
  }
  void move_into_bounds() {  // other coefficients of the same force, by projected Gauss-Seidel
    const double low = span_[0], high = span_[1];
    const auto is_inside = [&](double x) { return low <= x && x <= high; };
    if (std::all_of(q_.begin(), q_.end(), is_inside)) return;
    for (int k = 0; k < P_; ++k) {
      right_[std::size_t(k)] = detail::dot(q_.data(), gram_.data() + std::size_t(k) * P_, P_);
      wanted_[std::size_t(k)] = std::min(std::max(q_[std::size_t(k)], low), high);
    }
    const double size = detail::dot(q_.data(), right_.data(), P_);
    for (int sweep = 0; sweep < 2000; ++sweep) {
      double distance = 0;
      for (int k = 0; k < P_; ++k) {
        const double own = gram_[std::size_t(k * P_ + k)], rest = right_[std::size_t(k)] - detail::dot(wanted_.data(), gram_.data() + std::size_t(k) * P_, P_);
        if (own > 0) wanted_[std::size_t(k)] = std::min(std::max(wanted_[std::size_t(k)] + rest / own, low), high);
      }
      for (int k = 0; k < P_; ++k) scratch_[std::size_t(k)] = wanted_[std::size_t(k)] - q_[std::size_t(k)];
      for (int k = 0; k < P_; ++k) distance += scratch_[std::size_t(k)] * detail::dot(scratch_.data(), gram_.data() + std::size_t(k) * P_, P_);
      if (!(distance > 1e-12 * size)) {
        q_ = wanted_;
        return;
      }
    }
  }

  // ---------------------------------------------------------------- error
  double error() {
    if (!(answer_.min_det_F > 0)) return std::numeric_limits<double>::infinity();
    if (detail::norm(load_) == 0 && !is_moved_) return 0;
    if (answer_.range == Range::inside && answer_.residual < 1) return estimated_error(error_factor_, error_exponents_, least_sizes_, answer_.sizes);
    const double size = detail::norm(u_);
    return correction() / size;
  }
  // Norm of R K(0)^-1 R^T r with the rotations R of the nodes, see dpl.fem.solvers.corotational.
  double correction() {
    gradients_of_nodes_.assign(9 * volumes_.size(), 0.0);
    detail::add_node_gradients(cells_, u_.data(), gradients_of_nodes_.data());
    for (int first = 0; first < nodes(); first += detail::W) {
      double lanes[9 * detail::W];
      detail::V X[9];
      const auto node = [&](int l) { return std::size_t(std::min(first + l, nodes() - 1)); };
      for (int r = 0; r < 9; ++r) {
        for (int l = 0; l < detail::W; ++l) lanes[r * detail::W + l] = (r % 4 == 0) + gradients_of_nodes_[9 * node(l) + r] / std::max(volumes_[node(l)], 1e-300);
        X[r] = detail::load(lanes + r * detail::W);
      }
      detail::rotation(X, 5);
      for (int r = 0; r < 9; ++r) detail::store(lanes + r * detail::W, X[r]);
      for (int l = 0; l < detail::W && first + l < nodes(); ++l) {
        double *f = residual_.data() + 3 * node(l), turned[3] = {0, 0, 0};
        bool is_turned = free_[3 * node(l)] && free_[3 * node(l) + 1] && free_[3 * node(l) + 2];
        for (int r = 0; r < 9; ++r) is_turned = is_turned && std::abs(lanes[r * detail::W + l]) < 1.001;
        for (int r = 0; r < 9; ++r) turned[r % 3] += lanes[r * detail::W + l] * f[r / 3];
        for (int i = 0; i < 3 && is_turned; ++i) f[i] = turned[i];
      }
    }
    set_parts(residual_);
    solve_at_rest();
    set_field();  // u_ is not needed any more
    double square = 0;
    for (std::size_t k = 0; k < u_.size(); ++k) square += free_[k] ? u_[k] * u_[k] : 0.0;
    return std::sqrt(square);
  }

  detail::LawFunctions law_{};
  double (*internal_force_)(const detail::Cells&, const double*, double*) = nullptr;
  double length_ = 1, force_unit_ = 1, largest_force_ = 1, error_factor_ = 0;
  int M_ = 0, m_ = 0, R_ = 0, r_ = 0, b_ = 0, K_ = 0, P_ = 0;
  bool is_moved_ = false;
  std::string family_;
  std::size_t sample_law_step_ = 0;
  detail::Cells cells_;
  detail::Condensed condensed_;
  std::vector<std::uint8_t> free_, loadable_;
  std::vector<std::int32_t> dofs_, columns_, surface_, triangles_, load_nodes_, shape_of_node_;
  std::vector<float> modes_, gradients_, first_, maps_, float_forces_, float_solution_, float_work_;
  Doubles points_, prescribed_, characters_, signs_, scales_, supports_, reduced_, rest_, entry_signs_,
      first_signs_, map_signs_, limits_, error_exponents_, least_sizes_, sample_law_, volumes_, constant_force_, shapes_, span_;
  std::map<std::string, Patch> patches_;
  Answer answer_;
  Doubles load_, u_, internal_, residual_, reactions_, own_force_, patch_force_, parts_, forces_, solution_, exact_solution_, condensed_work_,
      linear_gradients_, present_, features_, stress_, split_, own_, linear_, total_, step_, sum_, q_, right_, wanted_, scratch_,
      gram_, axes_, values_, rest_force_, rows_, gradients_of_nodes_;
};

}  // namespace dpl
