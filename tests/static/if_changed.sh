#!/usr/bin/env bash
# if_changed.sh STAMP PATH... -- COMMAND...
# Runs COMMAND, unless it passed before and no file below the paths has changed since. Use it for
# checks that depend only on the sources.
set -euo pipefail

stamp=$1
shift
paths=()
while [[ $1 != -- ]]; do
  paths+=("$1")
  shift
done
shift

if [[ -e $stamp && -z $(find "${paths[@]}" -newer "$stamp" -print -quit) ]]; then
  echo "passed before, nothing changed since"
  exit 0
fi
mkdir -p "$(dirname "$stamp")"
touch "$stamp.started"
"$@"
mv "$stamp.started" "$stamp"
