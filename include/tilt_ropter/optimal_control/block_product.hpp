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

/// Which blocks of a matrix can be non-zero: here all, of `Size` rows and columns each.
template <int Size>
struct FullBlocks {
  static constexpr int size = Size;
  static constexpr bool nonzero(int /*row*/, int /*column*/) { return true; }
};

/// y += x m for `Rows` rows from `first` on and the columns of block `column`. x has `inner` times
/// the block's size of columns, m(i, j) is a function of which only the non-zero blocks are called
/// for.
template <int Rows, typename Blocks, typename X, typename M, typename Y, int... j>
inline void add_tile(const X& x, const M& m, Y& y, Eigen::Index first, int column, int inner,
                     std::integer_sequence<int, j...>) {
  constexpr int size = Blocks::size;
  static_assert(size == sizeof...(j));
  const int start = size * column;
  // The loop over a block's columns is written out, for the sums to stay in registers.
  Eigen::Matrix<double, Rows, 1> sum[] = {y.col(start + j).template segment<Rows>(first)...};
  for (int block = 0; block < inner; ++block) {
    if (!Blocks::nonzero(block, column)) continue;
    for (int i = size * block; i < size * (block + 1); ++i) {
      const Eigen::Matrix<double, Rows, 1> part = x.col(i).template segment<Rows>(first);
      ((sum[j] += part * m(i, start + j)), ...);
    }
  }
  ((y.col(start + j).template segment<Rows>(first) = sum[j]), ...);
}

/// y += x m for the rows from `first` on of the columns of block `column`.
template <typename Blocks, typename X, typename M, typename Y>
inline void add_rows(const X& x, const M& m, Y& y, int first, int column, int inner) {
  constexpr auto columns = std::make_integer_sequence<int, Blocks::size>{};
  constexpr int rows = Y::RowsAtCompileTime, most = 3 * packet_size;  // so many fit the registers
  for (; first + most <= rows; first += most)
    add_tile<most, Blocks>(x, m, y, first, column, inner, columns);
  for (; first < rows; first += packet_size)
    add_tile<packet_size, Blocks>(x, m, y, first, column, inner, columns);
}

/// y += x m; x has `Inner` columns, m and y have `Columns`, y has a multiple of packet_size rows.
template <typename Blocks, int Inner, int Columns, typename X, typename M, typename Y>
[[gnu::flatten]] inline void add_product(const X& x, const M& m, Y& y) {
  for (int column = 0; column < Columns / Blocks::size; ++column)
    add_rows<Blocks>(x, m, y, 0, column, Inner / Blocks::size);
}

/// The same without the rows above the entry (j + Offset, j) of each column j, whose sums in y mean
/// nothing afterwards.
template <typename Blocks, int Inner, int Columns, int Offset, typename X, typename M, typename Y>
[[gnu::flatten]] inline void add_lower_product(const X& x, const M& m, Y& y) {
  for (int column = 0; column < Columns / Blocks::size; ++column) {
    const int first = (Offset + Blocks::size * column) / packet_size * packet_size;
    add_rows<Blocks>(x, m, y, first, column, Inner / Blocks::size);
  }
}

/// Rows of x that add_batch() takes at a time: x and y need room for a multiple of it.
constexpr int batch_rows = 2 * packet_size;

/// y += x m for at least `rows` rows; m has `Columns` columns.
template <typename Blocks, int Inner, int Columns, typename X, typename M, typename Y>
[[gnu::flatten]] inline void add_batch(const X& x, const M& m, Y& y, Eigen::Index rows) {
  constexpr auto columns = std::make_integer_sequence<int, Blocks::size>{};
  for (Eigen::Index first = 0; first < rows; first += batch_rows)
    for (int column = 0; column < Columns / Blocks::size; ++column)
      add_tile<batch_rows, Blocks>(x, m, y, first, column, Inner / Blocks::size, columns);
}

}  // namespace tilt_ropter
