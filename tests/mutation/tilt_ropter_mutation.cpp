#include <tilt_ropter_mutation.hpp>

#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>

#include <cstdlib>

namespace {

constexpr int most = 1 << 16;  // more than the library has lines
unsigned char unread[most];

}  // namespace

int tilt_ropter_mutant = 0;
unsigned char* tilt_ropter_reached = unread;

// The faults that a test reaches are bytes of a file. All processes of the test map the file, so
// that those count which the test starts and those that are killed.
[[gnu::constructor]] static void read_environment() {
  if (const char* number = std::getenv("TILT_ROPTER_MUTANT"))
    tilt_ropter_mutant = std::atoi(number);
  const char* path = std::getenv("TILT_ROPTER_REACHED");
  if (path == nullptr) return;
  const int file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
  if (file < 0 || ftruncate(file, most) != 0) std::abort();
  void* bytes = mmap(nullptr, most, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  if (bytes == MAP_FAILED) std::abort();
  close(file);
  tilt_ropter_reached = static_cast<unsigned char*>(bytes);
}
