#!/usr/bin/env bash
# cortex_m7.sh
# Runs examples/microcontroller/run.sh, prints its figures, and fails if a figure is above what was
# reached before by more than 10 %, or a flight of the board differs from that on the desk. The
# table also says what is wanted.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
mkdir -p build-microcontroller
figures=build-microcontroller/figures.txt
bash examples/microcontroller/run.sh | tee "$figures"

# figure, at most, wanted (-: nothing more)
awk '
  FNR == NR { value[substr($1, 1, length($1) - 1)] = $2; next }
  function judge(name, ok, text) {
    printf "%-52s %s%s\n", name, text, ok ? "" : "  FAILED"
    if (!ok) failed = 1
  }
  NF == 3 {
    known = $1 in value
    text = sprintf("%12s  at most %9s", value[$1], $2) ($3 == "-" ? "" : "  wanted " $3)
    judge($1, known && value[$1] + 0 <= $2 + 0, text)
  }
  END {
    counted = value["rounds_1e6_instructions"]
    judge("rounds_1e6_instructions", counted >= 1999000 && counted <= 2001000, counted)
    for (n = 10; n <= 20; n += 10)
      for (i = split("hover figure_eight step", flight); i >= 1; --i) {
        key = flight[i] "_" n
        desk = value[key "_desk_rmse_m"]
        board = value[key "_board_rmse_m"]
        judge(key "_rmse_m", desk > 0 && board > 0.99 * desk && board < 1.01 * desk,
          "desk " desk "  board " board)
      }
    exit failed
  }
' "$figures" - << 'TABLE'
hover_10_board_controller_instructions_worst 2.17e6 1.2e6
figure_eight_10_board_controller_instructions_worst 2.17e6 1.2e6
step_10_board_controller_instructions_worst 19.6e6 4e6
step_10_limited_board_controller_instructions_worst 4.75e6 4e6
hover_10_board_heap_bytes 769e3 400e3
hover_20_board_controller_instructions_worst 4.12e6 2.5e6
figure_eight_20_board_controller_instructions_worst 4.12e6 2.5e6
step_20_board_controller_instructions_worst 38.7e6 10e6
step_20_limited_board_controller_instructions_worst 11e6 10e6
hover_20_board_heap_bytes 1300e3 -
step_10_board_heap_calls_in_flight 0 0
step_20_board_heap_calls_in_flight 0 0
step_20_board_stack_bytes 30e3 -
hover_10_board_filter_instructions_worst 138e3 -
hover_10_board_observer_instructions_worst 4000 -
hover_10_board_allocation_instructions_worst 5370 -
allocation_float_instructions_worst 3880 -
observer_float_instructions_worst 1280 -
filter_pose_float_instructions_worst 360e3 -
servo_float_instructions_worst 220 -
rotor_speed_float_difference_1e9_rad_per_s 1e6 -
observer_float_difference_1e9_n 1e5 -
filter_float_difference_1e9_m 1e4 -
module_double_code_bytes 65e3 -
module_float_code_bytes 70e3 -
module_float_objects_bytes 2700 -
module_float_stack_bytes 4300 -
flight_controller_code_bytes 513e3 -
TABLE
