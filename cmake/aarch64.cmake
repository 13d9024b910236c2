# Toolchain file: compiles for aarch64 with g++-aarch64-linux-gnu of Debian. Programs run with
# qemu-user, also when CMake calls them during the build. Libraries for aarch64 are found in
# CMAKE_PREFIX_PATH; headers that do not depend on the processor come from this system.
set(CMAKE_SYSTEM_NAME Linux)
set(CMAKE_SYSTEM_PROCESSOR aarch64)
set(CMAKE_CXX_COMPILER aarch64-linux-gnu-g++)
set(CMAKE_CROSSCOMPILING_EMULATOR qemu-aarch64 -L /usr/aarch64-linux-gnu)
