#pragma once

#include <Eigen/Core>  // with clang it declares posix_memalign, defined below

#include <nlopt.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdlib>

/// Counts every use of the heap in a program, by who asked for it: NLopt, or anything else. For one
/// source file of a program, before any header that calls NLopt. malloc and its kin are replaced by
/// functions that count and go on to the C library's own; operator new comes here through malloc.
/// Where that cannot be (sanitizers bring their own malloc; another C library),
/// heap_can_be_counted is false and nothing is replaced.
namespace test_support {

#if defined(__has_feature)
#define TILT_ROPTER_TEST_HAS_FEATURE(name) __has_feature(name)
#else
#define TILT_ROPTER_TEST_HAS_FEATURE(name) 0
#endif
#if !defined(__GLIBC__) || defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__) || \
    TILT_ROPTER_TEST_HAS_FEATURE(address_sanitizer) ||                                      \
    TILT_ROPTER_TEST_HAS_FEATURE(thread_sanitizer) ||                                       \
    TILT_ROPTER_TEST_HAS_FEATURE(memory_sanitizer)
constexpr bool heap_can_be_counted = false;
#else
#define TILT_ROPTER_TEST_COUNTS_HEAP
constexpr bool heap_can_be_counted = true;
#endif
#undef TILT_ROPTER_TEST_HAS_FEATURE

enum class HeapUser { other, nlopt };

struct HeapUse {
  long allocations = 0;  ///< calls that ask for memory
  long releases = 0;     ///< calls that give it back
  long bytes = 0;        ///< asked for, summed over the calls

  [[nodiscard]] bool none() const { return allocations == 0 && releases == 0; }
  friend HeapUse operator+(const HeapUse& a, const HeapUse& b) {
    return {a.allocations + b.allocations, a.releases + b.releases, a.bytes + b.bytes};
  }
  friend HeapUse operator-(const HeapUse& a, const HeapUse& b) {
    return {a.allocations - b.allocations, a.releases - b.releases, a.bytes - b.bytes};
  }
};

namespace detail {

// Atomic only because compilers take malloc for a function that changes no variable.
struct HeapCounter {
  std::atomic<long> allocations{0}, releases{0}, bytes{0};
};
inline std::array<HeapCounter, 2> heap_counters;
inline std::atomic<HeapUser> heap_user{HeapUser::other};

inline HeapCounter& heap_counter(HeapUser user) {
  return heap_counters[static_cast<std::size_t>(user)];
}

inline void count_allocation(std::size_t bytes) noexcept {
  HeapCounter& counter = heap_counter(heap_user);
  ++counter.allocations;
  counter.bytes += static_cast<long>(bytes);
}

inline void count_release() noexcept {
  ++heap_counter(heap_user).releases;
}

/// The heap's user is another one for a while.
class Acting {
 public:
  explicit Acting(HeapUser user) : before_(heap_user.exchange(user)) {}
  ~Acting() { heap_user = before_; }
  Acting(const Acting&) = delete;
  Acting& operator=(const Acting&) = delete;

 private:
  HeapUser before_;
};

}  // namespace detail

/// Since the start of the program.
[[nodiscard]] inline HeapUse heap_use(HeapUser user) {
  const detail::HeapCounter& counter = detail::heap_counter(user);
  return {counter.allocations, counter.releases, counter.bytes};
}

/// What calls of nlopt_optimize took since this was last set to {}.
struct NloptCalls {
  long count = 0;
  HeapUse sum;
  std::array<HeapUse, 256> largest{};  ///< one call's most, by its number of variables
};
inline NloptCalls nlopt_calls;

/// A function of NLopt.
template <auto function, typename... Arguments>
auto in_nlopt(Arguments... arguments) {
  const detail::Acting nlopt(HeapUser::nlopt);
  return function(arguments...);
}

/// A function that NLopt calls back is not NLopt's.
template <nlopt_func objective>
double called_back(unsigned n, const double* x, double* gradient, void* data) {
  const detail::Acting other(HeapUser::other);
  return objective(n, x, gradient, data);
}

inline nlopt_result optimize(nlopt_opt optimizer, double* x, double* value) {
  const HeapUse before = heap_use(HeapUser::nlopt);
  const nlopt_result result = in_nlopt<nlopt_optimize>(optimizer, x, value);
  const HeapUse use = heap_use(HeapUser::nlopt) - before;
  HeapUse& largest = nlopt_calls.largest.at(nlopt_get_dimension(optimizer));
  largest.allocations = std::max(largest.allocations, use.allocations);
  largest.releases = std::max(largest.releases, use.releases);
  largest.bytes = std::max(largest.bytes, use.bytes);
  ++nlopt_calls.count;
  nlopt_calls.sum = nlopt_calls.sum + use;
  return result;
}

}  // namespace test_support

// The headers' calls of NLopt go through the functions above. One that is missing here is counted
// as not NLopt's, which a test sees.
#define nlopt_create test_support::in_nlopt<nlopt_create>
#define nlopt_destroy test_support::in_nlopt<nlopt_destroy>
#define nlopt_force_stop test_support::in_nlopt<nlopt_force_stop>
#define nlopt_optimize test_support::optimize
#define nlopt_set_ftol_rel test_support::in_nlopt<nlopt_set_ftol_rel>
#define nlopt_set_lower_bounds test_support::in_nlopt<nlopt_set_lower_bounds>
#define nlopt_set_maxeval test_support::in_nlopt<nlopt_set_maxeval>
#define nlopt_set_min_objective(optimizer, objective, data)                                        \
  test_support::in_nlopt<nlopt_set_min_objective>(optimizer, test_support::called_back<objective>, \
                                                  static_cast<void*>(data))
#define nlopt_set_upper_bounds test_support::in_nlopt<nlopt_set_upper_bounds>
#define nlopt_set_vector_storage test_support::in_nlopt<nlopt_set_vector_storage>

#ifdef TILT_ROPTER_TEST_COUNTS_HEAP
extern "C" {

// NOLINTBEGIN(bugprone-reserved-identifier): the names that glibc gives its own functions.
void* __libc_malloc(std::size_t size);
void* __libc_calloc(std::size_t count, std::size_t size);
void* __libc_realloc(void* memory, std::size_t size);
void* __libc_memalign(std::size_t alignment, std::size_t size);
void __libc_free(void* memory);
// NOLINTEND(bugprone-reserved-identifier)

void* malloc(std::size_t size) noexcept {
  test_support::detail::count_allocation(size);
  return __libc_malloc(size);
}

void* calloc(std::size_t count, std::size_t size) noexcept {
  test_support::detail::count_allocation(count * size);
  return __libc_calloc(count, size);
}

void* realloc(void* memory, std::size_t size) noexcept {
  test_support::detail::count_allocation(size);
  if (memory != nullptr) test_support::detail::count_release();
  return __libc_realloc(memory, size);
}

void* memalign(std::size_t alignment, std::size_t size) noexcept {
  test_support::detail::count_allocation(size);
  return __libc_memalign(alignment, size);
}

void* aligned_alloc(std::size_t alignment, std::size_t size) noexcept {
  test_support::detail::count_allocation(size);
  return __libc_memalign(alignment, size);
}

int posix_memalign(void** memory, std::size_t alignment, std::size_t size) noexcept {
  test_support::detail::count_allocation(size);
  *memory = __libc_memalign(alignment, size);
  return *memory != nullptr ? 0 : ENOMEM;
}

void free(void* memory) noexcept {
  if (memory != nullptr) test_support::detail::count_release();
  __libc_free(memory);
}

}  // extern "C"
#endif
