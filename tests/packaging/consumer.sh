#!/usr/bin/env bash
# consumer.sh installed|subdirectory|copied SOURCE_DIR
# Builds and runs a stranger's program outside the tree, by one of the ways to use the library.
set -euo pipefail

way=$1
source=$2
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cp -r "$source/tests/packaging/consumer" "$away/consumer"
cd "$away/consumer"

case $way in
  installed)
    cmake -S "$source" -B "$away/build" -DTILT_ROPTER_BUILD_TESTS=OFF \
      -DTILT_ROPTER_BUILD_EXAMPLES=OFF -DTILT_ROPTER_BUILD_BENCHMARKS=OFF
    cmake --install "$away/build" --prefix "$away/prefix"
    mv "$away/prefix" "$away/moved"
    if grep -rlF -e "$source" -e "$away" "$away/moved"; then
      echo "installed files must not name the directories they came from"
      exit 1
    fi
    test -n "$(find "$away/moved" -name LICENSE)"
    cmake -S . -B build -DCMAKE_PREFIX_PATH="$away/moved"
    cmake --build build
    build/consumer ;;
  subdirectory)
    cmake -S . -B build -DTILT_ROPTER_SOURCE_DIR="$source"
    cmake --build build
    build/consumer ;;
  copied)
    cp -r "$source/include/tilt_ropter" .
    eigen=${EIGEN_DIR:-/usr/include/eigen3}
    set -x
    "${CXX:-g++}" -std=c++17 -I . -I "$eigen" main.cpp -lnlopt -o consumer
    ./consumer ;;
esac
