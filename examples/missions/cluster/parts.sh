# Common part of parallel.sh and slurm.sh, which source it: their options, and the parts of a run.
# The part that starts with vehicle FIRST is flown to the directory OUTPUT/parts/FIRST.
# shellcheck shell=bash disable=SC2034

output=results
program=build/examples/monte_carlo
first=0
count=1000
chunk=20
jobs=
wait=
flight_options=()  # for monte_carlo, of each part and of the merged table
merge_options=()

common_help='  -o, --output DIR   directory of the run [results]; the parts are in DIR/parts
  --first N          index of the first vehicle [0]
  --count N          number of vehicles [1000]
  --chunk N          vehicles per part [20]; keep it when you continue a run
  --program PATH     monte_carlo [build/examples/monte_carlo]
  --no-pictures      write only the tables
  --help             print this text
  OPTION VALUE       an option of monte_carlo: --seed, --vehicle, --level

Vehicles depend on seed and index only: the result is that of a single monte_carlo to the bit,
whatever the parts. Interrupt it, kill jobs: the same command goes on with the vehicles that are
missing. The exit code is that of monte_carlo --merge: 3 if vehicles are missing.'

fail() {  # message
  echo "$(basename "$0"): $1" >&2
  exit 2
}

whole_number() {  # option, value, smallest value
  [[ $2 =~ ^(0|[1-9][0-9]{0,14})$ && $2 -ge $3 ]] ||
    fail "$1 $2: must be a whole number, $3 or more"
}

# Sets the variables above.
read_options() {  # options of the script
  local option
  while [[ $# -gt 0 ]]; do
    option=$1
    case $option in
      --help | -h) usage && exit 0 ;;
      --no-pictures) merge_options+=("$option") && shift && continue ;;
      --wait) wait=1 && shift && continue ;;
      --resume | --threads* | --merge* | --replay*)
        fail "$option: not here; each job has one thread and resumes by itself" ;;
      --*=*) set -- "${option%%=*}" "${option#*=}" "${@:2}" && continue ;;
    esac
    [[ $# -ge 2 ]] || fail "$option: needs a value"
    case $option in
      -o | --output) output=$2 ;;
      --program) program=$2 ;;
      --first) whole_number "$1" "$2" 0 && first=$2 ;;
      --count) whole_number "$1" "$2" 1 && count=$2 ;;
      --chunk) whole_number "$1" "$2" 1 && chunk=$2 ;;
      --jobs) whole_number "$1" "$2" 1 && jobs=$2 ;;
      --*) flight_options+=("$1" "$2") ;;
      *) fail "$option: unknown option" ;;
    esac
    shift 2
  done
  [[ -x $program && ! -d $program ]] || fail "--program $program: no such program; build it first"
  mkdir -p "$output/parts"
  end=$((first + count))
  parts=$(((count + chunk - 1) / chunk))
}

# The command of a part for a shell, and of the merged table. FIRST and COUNT are put in as they are.
part_command() {  # FIRST COUNT
  printf '%q ' "$program" "${flight_options[@]}" --threads 1 --no-pictures --resume
  printf -- '--first %s --count %s --output %q/%s' "$1" "$2" "$output/parts" "$1"
}
merge_command() {
  printf '%q ' "$program" "${flight_options[@]}" "${merge_options[@]}" --first "$first" \
    --count "$count" --output "$output" --merge "$output/parts"
}
