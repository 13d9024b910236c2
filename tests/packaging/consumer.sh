#!/usr/bin/env bash
# consumer.sh installed|packed|subdirectory|copied SOURCE_DIR
# Builds and runs the program of a user outside the tree, with one of the ways to use the library.
set -euo pipefail

way=$1
source=$2
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cp -r "$source"/tests/packaging/{consumer,core,vehicle_file} "$away"
cd "$away/consumer"

case $way in
  installed)
    cmake -S "$source" -B "$away/build" -DTILT_ROPTER_BUILD_EXAMPLES=OFF
    cmake --install "$away/build" --prefix "$away/prefix"
    mv "$away/prefix" "$away/moved"
    if grep -rlF -e "$source" -e "$away" "$away/moved"; then
      echo "installed files must not name the directories they came from"
      exit 1
    fi
    test -n "$(find "$away/moved" -name LICENSE)"
    cmake -S . -B build -DCMAKE_PREFIX_PATH="$away/moved"
    cmake --build build
    build/consumer
    cmake -S ../core -B build_core -DCMAKE_PREFIX_PATH="$away/moved"
    cmake --build build_core
    build_core/core
    cmake -S ../vehicle_file -B build_vehicle_file -DCMAKE_PREFIX_PATH="$away/moved"
    cmake --build build_vehicle_file
    read_it=(build_vehicle_file/vehicle_file "$source/examples/vehicles/hexacopter_with_pusher.json")
    [[ $("${read_it[@]}") == "hexacopter with pusher, on legs: 7 rotors" ]]
    if build_vehicle_file/vehicle_file /dev/null; then exit 1; fi ;;
  packed)  # as .deb and as sources; the .deb is also used by pkg-config
    cmake -S "$source" -B "$away/build" -DCMAKE_INSTALL_PREFIX=/usr -DTILT_ROPTER_BUILD_EXAMPLES=OFF
    (cd "$away/build" && cpack -G DEB && cpack --config CPackSourceConfig.cmake)
    dpkg-deb --field "$away"/build/libtilt-ropter-dev_*_all.deb
    dpkg-deb -x "$away"/build/libtilt-ropter-dev_*_all.deb "$away/root"
    cmake -S . -B build -DCMAKE_PREFIX_PATH="$away/root/usr"
    export PKG_CONFIG_PATH=$away/root/usr/share/pkgconfig
    read -ra flags <<< "$(pkg-config --cflags --libs tilt_ropter)"
    "${CXX:-g++}" -std=c++17 main.cpp "${flags[@]}" -o by_pkg_config
    ./by_pkg_config
    tar -xzf "$away"/build/tilt_ropter-*.tar.gz -C "$away"
    cmake -S . -B build_source -DTILT_ROPTER_SOURCE_DIR="$(echo "$away"/tilt_ropter-*/)" ;;
  subdirectory)
    cmake -S . -B fetched -DTILT_ROPTER_FETCH="$source"
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
