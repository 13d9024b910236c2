# Toolchain file: compiles for aarch64 with Debian's g++-aarch64-linux-gnu and runs the programs
# under qemu-user, CMake's calls of them while it builds included. Libraries for aarch64 are looked
# for in CMAKE_PREFIX_PATH; headers that are the same for every processor are those of this system.
set(CMAKE_SYSTEM_NAME Linux)
set(CMAKE_SYSTEM_PROCESSOR aarch64)
set(CMAKE_CXX_COMPILER aarch64-linux-gnu-g++)
set(CMAKE_CROSSCOMPILING_EMULATOR qemu-aarch64 -L /usr/aarch64-linux-gnu)
