#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat << 'HELP'
usage: examples/microcontroller/run.sh [FLIGHT INTERVALS [LIMIT]]

Installs missing Debian packages with apt-get, builds the programs of this folder into
build-microcontroller/ for a Cortex-M7, and runs them with QEMU on an emulated mps2-an500. Prints
lines `key: value`: instructions of each piece, sizes, and the figures of flights on the desk and on
the board.

  FLIGHT     only this flight: hover, figure_eight or step (of 5 m)
  INTERVALS  of 0.1 s in the controller's horizon
  LIMIT      instructions after which the solver ends a tick with its best plan so far
  --help     print this text

OPTIMISE (default -O2) is the optimisation of the board's programs.
HELP
}

case ${1-} in
  --help | -h) usage && exit 0 ;;
  '') flights=("hover 10" "figure_eight 10" "step 10" "step 10 4e6"
    "hover 20" "figure_eight 20" "step 20" "step 20 10e6") ;;
  hover | figure_eight | step)
    [[ ${2-} =~ ^[1-9][0-9]*$ && $# -le 3 ]] || { usage >&2 && exit 2; }
    flights=("$*")
    ;;
  *) usage >&2 && exit 2 ;;
esac
here=$(realpath "$(dirname "${BASH_SOURCE[0]}")")
top=$here/../..
out=$(realpath "$top")/build-microcontroller
bash "$top/cmake/install_missing.sh" g++ gcc-arm-none-eabi libeigen3-dev libnlopt-dev \
  libstdc++-arm-none-eabi-newlib qemu-system-arm >&2
mkdir -p "$out"

compile=(-std=c++17 -Wall -Wextra -Werror -I "$top/include" -isystem /usr/include/eigen3)
board=("${OPTIMISE--O2}" -mcpu=cortex-m7 -mthumb -mfpu=fpv5-d16 -mfloat-abi=hard
  -fno-exceptions -fno-rtti -fno-threadsafe-statics -fno-unwind-tables
  -fno-asynchronous-unwind-tables -ffunction-sections -fdata-sections -Wno-psabi
  -DTILT_ROPTER_WITHOUT_NLOPT "${compile[@]}")
link=(--specs=nano.specs -u _printf_float -nostartfiles -Wl,--gc-sections -Wl,--wrap=malloc
  -T "$here/mps2_an500.ld")
for_board() {  # program, source, definitions
  arm-none-eabi-g++ "${board[@]}" "${@:3}" "$here/$2.cpp" "$here/board.cpp" "${link[@]}" \
    -o "$out/$1.elf"
}
emulate() {  # program
  timeout 3000 qemu-system-arm -M mps2-an500 -nographic -monitor none -serial null -icount shift=0 \
    -semihosting-config enable=on,target=native -kernel "$out/$1.elf"
}
code_bytes() {  # program
  arm-none-eabi-size "$out/$1.elf" | awk 'NR == 2 { print $1 + $2 }'
}

echo "== Building into build-microcontroller/" >&2
"${CXX:-g++}" -O2 "${compile[@]}" "$here/fly.cpp" -lnlopt -o "$out/fly" &
host=$!
for_board flight_controller flight_controller
wait $host
if [[ $# -eq 0 ]]; then
  for_board empty module -DEMPTY
  for_board module_double module -DSCALAR=double
  for_board module_float module -DSCALAR=float
  for_board pieces pieces

  emulate pieces 2>&1
  for module in module_double module_float; do
    echo "${module}_code_bytes: $(($(code_bytes $module) - $(code_bytes empty)))"
    emulate $module 2>&1 | sed "s/^/${module}_/"
  done
  echo "flight_controller_code_bytes: $(code_bytes flight_controller)"
fi

for flight in "${flights[@]}"; do
  read -r name intervals limit <<< "$flight"
  key=${name}_$intervals${limit:+_limited}
  [[ $limit ]] || "$out/fly" "$name" "$intervals" | sed "s/^/${key}_desk_/"
  rm -rf "${out:?}/$key"
  mkdir "$out/$key"
  mkfifo "$out/$key/to_board" "$out/$key/from_board"
  (cd "$out/$key" && emulate flight_controller > emulator.txt 2>&1) &
  emulator=$!
  timeout 3000 "$out/fly" "$name" "$intervals" "$out/$key" $limit | sed "s/^/${key}_board_/" ||
    { kill $emulator && exit 1; }
  wait $emulator
done
