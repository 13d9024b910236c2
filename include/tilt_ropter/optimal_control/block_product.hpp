#pragma once

#include <Eigen/Core>

#include <algorithm>
#include <type_traits>
#include <utility>

/// Products with small matrices whose zero blocks are known when compiling. A Riccati pass consists
/// of little else, and general products spend most of their time on zeros, packing and calls.
namespace tilt_ropter {

/// Numbers in a vector register.
constexpr int packet_size =
    EIGEN_MAX_STATIC_ALIGN_BYTES >= 16 ? EIGEN_MAX_STATIC_ALIGN_BYTES / 8 : 1;
/// Rows made up to whole registers, so that no product has a remainder.
constexpr int padded(int rows) {
  return (rows + packet_size - 1) / packet_size * packet_size;
}

template <typename Function, int... i>
[[gnu::always_inline]] constexpr void for_each_index(const Function& f,
                                                     std::integer_sequence<int, i...>) {
  (f(std::integral_constant<int, i>{}), ...);
}
/// f(integral_constant<int, i>) for i = 0 .. Count - 1.
template <int Count, typename Function>
[[gnu::always_inline]] constexpr void for_each_index(const Function& f) {
  for_each_index(f, std::make_integer_sequence<int, Count>{});
}

/// Which blocks of a matrix can be non-zero: here all, of `Size` rows and columns each.
template <int Size>
struct FullBlocks {
  static constexpr int size = Size;
  static constexpr bool nonzero(int /*row*/, int /*column*/) { return true; }
};

/// y += x m for `Rows` rows from `first` on and the columns of block `column`. x has `Inner`
/// columns, m(i, j) is a function of which only the non-zero blocks are called for.
template <typename Blocks, int Inner, int Rows, int column, typename X, typename M, typename Y>
inline void add_tile(const X& x, const M& m, Y& y, Eigen::Index first) {
  constexpr int size = Blocks::size;
  Eigen::Matrix<double, Rows, size> sum;  // in registers
  for_each_index<size>(
      [&](auto j) { sum.col(j) = y.col(size * column + j).template segment<Rows>(first); });
  for_each_index<Inner>([&](auto i) {
    constexpr int row = i;
    if constexpr (Blocks::nonzero(row / size, column)) {
      const auto part = x.col(row).template segment<Rows>(first);
      for_each_index<size>([&](auto j) { sum.col(j) += part * m(row, size * column + j); });
    }
  });
  for_each_index<size>(
      [&](auto j) { y.col(size * column + j).template segment<Rows>(first) = sum.col(j); });
}

/// y += x m for the rows from `First` to `Last` of the columns of block `column`.
template <typename Blocks, int Inner, int First, int Last, int column, typename X, typename M,
          typename Y>
inline void add_rows(const X& x, const M& m, Y& y) {
  constexpr int rows = std::min(Last - First, 3 * packet_size);  // so many sums fit the registers
  if constexpr (rows > 0) {
    add_tile<Blocks, Inner, rows, column>(x, m, y, First);
    add_rows<Blocks, Inner, First + rows, Last, column>(x, m, y);
  }
}

/// y += x m; x has `Inner` columns, m and y have `Columns`.
template <typename Blocks, int Inner, int Columns, typename X, typename M, typename Y>
[[gnu::flatten]] inline void add_product(const X& x, const M& m, Y& y) {
  for_each_index<Columns / Blocks::size>(
      [&](auto column) { add_rows<Blocks, Inner, 0, Y::RowsAtCompileTime, column>(x, m, y); });
}

/// The same without the rows above the entry (j + Offset, j) of each column j, whose sums in y mean
/// nothing afterwards.
template <typename Blocks, int Inner, int Columns, int Offset, typename X, typename M, typename Y>
[[gnu::flatten]] inline void add_lower_product(const X& x, const M& m, Y& y) {
  for_each_index<Columns / Blocks::size>([&](auto column) {
    constexpr int first = (Offset + Blocks::size * column) / packet_size * packet_size;
    add_rows<Blocks, Inner, first, Y::RowsAtCompileTime, column>(x, m, y);
  });
}

/// Rows of x that add_batch() takes at a time: x and y need room for a multiple of it.
constexpr int batch_rows = 2 * packet_size;

/// y += x m for at least `rows` rows; m has `Columns` columns.
template <typename Blocks, int Inner, int Columns, typename X, typename M, typename Y>
[[gnu::flatten]] inline void add_batch(const X& x, const M& m, Y& y, Eigen::Index rows) {
  for (Eigen::Index first = 0; first < rows; first += batch_rows)
    for_each_index<Columns / Blocks::size>(
        [&](auto column) { add_tile<Blocks, Inner, batch_rows, column>(x, m, y, first); });
}

}  // namespace tilt_ropter
