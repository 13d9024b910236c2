#pragma once

#include <Eigen/Core>  // with clang it declares posix_memalign, which is defined below

#include <dlfcn.h>
#include <nlopt.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdlib>

/// Counts every use of the heap in a program, separately for NLopt and for all other code. Include
/// it in one source file of a program only. It replaces malloc and related functions, and the
/// functions of NLopt that the library calls. The replacements count and then call the original
/// functions. operator new is counted through malloc. heap_can_be_counted is false where malloc
/// cannot be replaced (sanitizers have their own malloc; another C library).
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
  long allocations = 0;  ///< calls that allocate memory
  long releases = 0;     ///< calls that free memory
  long bytes = 0;        ///< allocated bytes, summed over the calls

  [[nodiscard]] bool none() const { return allocations == 0 && releases == 0; }
  friend HeapUse operator+(const HeapUse& a, const HeapUse& b) {
    return {a.allocations + b.allocations, a.releases + b.releases, a.bytes + b.bytes};
  }
  friend HeapUse operator-(const HeapUse& a, const HeapUse& b) {
    return {a.allocations - b.allocations, a.releases - b.releases, a.bytes - b.bytes};
  }
};

namespace detail {

// The counters are atomic only because compilers assume that malloc changes no variable.
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

/// Attributes the use of the heap to `user` during the lifetime of this object.
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

/// Returns the use of the heap by `user` since the start of the program.
[[nodiscard]] inline HeapUse heap_use(HeapUser user) {
  const detail::HeapCounter& counter = detail::heap_counter(user);
  return {counter.allocations, counter.releases, counter.bytes};
}

/// Use of the heap by calls of nlopt_optimize since this object was last set to {}.
struct NloptCalls {
  long count = 0;
  HeapUse sum;
  std::array<HeapUse, 256> largest{};  ///< largest use of a single call, by its number of variables
};
inline NloptCalls nlopt_calls;

namespace detail {

/// Returns the original function of this name in the library of NLopt.
template <auto function>
auto nlopts_own(const char* name) {
  static const auto own = reinterpret_cast<decltype(function)>(dlsym(RTLD_NEXT, name));
  return own;
}

/// An objective function that was passed to NLopt. Its use of the heap does not count as NLopt's.
struct Objective {
  nlopt_opt owner;
  nlopt_func function;
  void* data;
};
inline std::array<Objective, 256> objectives{};

inline Objective& objective_of(nlopt_opt owner) {
  for (Objective& objective : objectives)
    if (objective.owner == owner) return objective;
  if (owner == nullptr) std::abort();  // more optimisers than entries
  return objective_of(nullptr);
}

inline double called_back(unsigned n, const double* x, double* gradient, void* data) {
  const Acting other(HeapUser::other);
  const Objective& objective = *static_cast<Objective*>(data);
  return objective.function(n, x, gradient, objective.data);
}

inline nlopt_result optimize(nlopt_opt optimizer, double* x, double* value) {
  const auto own = nlopts_own<nlopt_optimize>("nlopt_optimize");
  if (heap_user == HeapUser::nlopt) return own(optimizer, x, value);  // called by NLopt itself
  const Acting nlopt(HeapUser::nlopt);
  const HeapUse before = heap_use(HeapUser::nlopt);
  const nlopt_result result = own(optimizer, x, value);
  const HeapUse use = heap_use(HeapUser::nlopt) - before;
  HeapUse& largest = nlopt_calls.largest.at(nlopt_get_dimension(optimizer));
  largest.allocations = std::max(largest.allocations, use.allocations);
  largest.releases = std::max(largest.releases, use.releases);
  largest.bytes = std::max(largest.bytes, use.bytes);
  ++nlopt_calls.count;
  nlopt_calls.sum = nlopt_calls.sum + use;
  return result;
}

}  // namespace detail
}  // namespace test_support

// The functions of NLopt that the library calls in its loop. The use of the heap by a function that
// is missing here does not count as NLopt's, so a test detects it.
// NOLINTBEGIN(bugprone-macro-parentheses): the arguments have them.
#define TILT_ROPTER_TEST_NLOPT(name, parameters, arguments)                  \
  nlopt_result name parameters {                                             \
    const test_support::detail::Acting nlopt(test_support::HeapUser::nlopt); \
    return test_support::detail::nlopts_own<name>(#name) arguments;          \
  }
// NOLINTEND(bugprone-macro-parentheses)
extern "C" {

TILT_ROPTER_TEST_NLOPT(nlopt_force_stop, (nlopt_opt o), (o))
TILT_ROPTER_TEST_NLOPT(nlopt_set_ftol_rel, (nlopt_opt o, double tolerance), (o, tolerance))
TILT_ROPTER_TEST_NLOPT(nlopt_set_lower_bounds, (nlopt_opt o, const double* bounds), (o, bounds))
TILT_ROPTER_TEST_NLOPT(nlopt_set_upper_bounds, (nlopt_opt o, const double* bounds), (o, bounds))
TILT_ROPTER_TEST_NLOPT(nlopt_set_maxeval, (nlopt_opt o, int most), (o, most))
TILT_ROPTER_TEST_NLOPT(nlopt_set_vector_storage, (nlopt_opt o, unsigned vectors), (o, vectors))

nlopt_opt nlopt_create(nlopt_algorithm algorithm, unsigned variables) {
  const test_support::detail::Acting nlopt(test_support::HeapUser::nlopt);
  return test_support::detail::nlopts_own<nlopt_create>("nlopt_create")(algorithm, variables);
}

void nlopt_destroy(nlopt_opt o) {
  const test_support::detail::Acting nlopt(test_support::HeapUser::nlopt);
  if (o != nullptr) test_support::detail::objective_of(o) = {};
  test_support::detail::nlopts_own<nlopt_destroy>("nlopt_destroy")(o);
}

nlopt_result nlopt_set_min_objective(nlopt_opt o, nlopt_func function, void* data) {
  using namespace test_support::detail;
  const auto own = nlopts_own<nlopt_set_min_objective>("nlopt_set_min_objective");
  // Called by NLopt itself.
  if (heap_user == test_support::HeapUser::nlopt) return own(o, function, data);
  const Acting nlopt(test_support::HeapUser::nlopt);
  Objective& objective = objective_of(o);
  objective = {o, function, data};
  return own(o, called_back, &objective);
}

nlopt_result nlopt_optimize(nlopt_opt o, double* x, double* value) {
  return test_support::detail::optimize(o, x, value);
}

}  // extern "C"
#undef TILT_ROPTER_TEST_NLOPT

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
