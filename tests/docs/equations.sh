#!/usr/bin/env bash
# equations.sh INCLUDE_DIR PAGE
# Checks the table in PAGE: every reference to the paper in a header below INCLUDE_DIR/tilt_ropter
# has a row for that header, and the name in every row exists in its header. Prints errors; then
# fails.
set -euo pipefail
shopt -s inherit_errexit

page=$(realpath "$2")
cd "$1/tilt_ropter"

# Lines like "model/frames.hpp|Sec. Frame Definition". A comment continues over all adjacent comment
# lines, and a reference ends at the closing bracket or the next comma.
references=$(
  find . -name '*.hpp' -printf '%P\n' | while read -r header; do
    awk '/^ *\/\/\// { sub(/^ *\/\/\/ ?/, ""); printf "%s ", $0; next } { print $0 ";" }' "$header" |
      grep -oE "paper('s)?,? (Secs?|Eqs?|Tab)\. [^;)]*" |
      grep -oE "(Secs?|Tab)\. [A-Z][A-Za-z -]*|Eqs?\. [A-Za-z0-9_-]+" |
      sed -E "s/ +$//; s|^|$header\||" || true  # most headers have none
  done | sort -u
)
# Lines like "model/frames.hpp|Sec. Frame Definition|body_in_world".
rows=$(awk -F ' *\\| *' '$5 ~ /@ref/ { sub(/.*::/, "", $5); print $4 "|" $2 "|" $5 }' "$page")
[[ $(wc -l <<< "$references") -gt 20 && $(wc -l <<< "$rows") -gt 20 ]] ||
  { echo "found next to nothing"; exit 1; }

wrong=$(
  while IFS= read -r reference; do
    grep -qF "$reference|" <<< "$rows" || echo "no row in $(basename "$page") for $reference"
  done <<< "$references"
  while IFS='|' read -r header _ name; do
    if [[ ! -f $header ]]; then
      echo "there is no $header"
    elif ! grep -qw "$name" <<< "$(sed 's|//.*||' "$header")"; then
      echo "$header has no $name"
    fi
  done <<< "$rows"
)
if [[ $wrong ]]; then
  echo "$wrong"
  exit 1
fi
echo "$(wc -l <<< "$references") references of the headers, all in $(wc -l <<< "$rows") rows"
