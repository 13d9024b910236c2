#!/usr/bin/env bash
# equations.sh INCLUDE_DIR PAGE
# Every place of the paper that a header below INCLUDE_DIR/tilt_ropter refers to has a row of that
# header in PAGE, and every row's header has the row's name. Prints what is not so, and then fails.
set -euo pipefail
shopt -s inherit_errexit

page=$(realpath "$2")
cd "$1/tilt_ropter"

# Lines like "model/frames.hpp|Sec. Frame Definition". A comment goes on over lines that are
# nothing but comment, and a reference to its bracket or the next comma.
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
