#!/usr/bin/env bash
# fly.sh PROGRAMS OUTPUT [OPTION...]
# Flies the mission with hitl_onboard, hitl_flight_controller and hitl_simulator of the directory
# PROGRAMS. What they print goes to OUTPUT/hitl_*.txt. The options of the line, --lock-step and
# --vehicle go to all three programs, --level and --solver to hitl_onboard, the others to
# hitl_simulator, whose exit code is that of this script.
set -euo pipefail

programs=$1
output=$2
shift 2
all=()
onboard=()
vehicle=()
while [[ $# -gt 0 ]]; do
  case $1 in
    --loss | --spike-share | --spike | --vehicle | --lock-step) all+=("$1" "${2-}") && shift ;;
    --loss=* | --spike-share=* | --spike=* | --vehicle=* | --lock-step=*) all+=("$1") ;;
    --level | --solver) onboard+=("$1" "${2-}") && shift ;;
    --level=* | --solver=*) onboard+=("$1") ;;
    *) vehicle+=("$1") ;;
  esac
  shift
done
mkdir -p "$output"
started=()
# They end when the simulator reports the end of the flight. If it fails, they end here.
trap '[[ ${#started[@]} -eq 0 ]] || kill "${started[@]}" 2> /dev/null || true' EXIT
"$programs/hitl_onboard" "${all[@]}" "${onboard[@]}" > "$output/hitl_onboard.txt" 2>&1 &
started+=($!)
"$programs/hitl_flight_controller" "${all[@]}" > "$output/hitl_flight_controller.txt" 2>&1 &
started+=($!)
"$programs/hitl_simulator" "${all[@]}" "${vehicle[@]}" > "$output/hitl_simulator.txt"
wait "${started[@]}"
started=()
