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
  paper="paper('s)?,? (Secs?|Eqs?|Tab)[.] [^;)]*"
  find . -name '*.hpp' -printf '%P\n' | xargs awk -v paper="$paper" '
    function refer(text, reference) {
      while (match(text, paper)) {
        reference = substr(text, RSTART, RLENGTH)
        text = substr(text, RSTART + RLENGTH)
        while (match(reference, /(Secs?|Tab)[.] [A-Z][A-Za-z -]*|Eqs?[.] [A-Za-z0-9_-]+/)) {
          one = substr(reference, RSTART, RLENGTH)
          reference = substr(reference, RSTART + RLENGTH)
          sub(/ +$/, "", one)
          print FILENAME "|" one
        }
      }
    }
    /^ *\/\/\// { sub(/^ *\/\/\/ ?/, ""); comment = comment " " $0; next }
    { refer(comment " " $0); comment = "" }' | sort -u
)
# Lines like "model/frames.hpp|Sec. Frame Definition|body_in_world".
rows=$(awk -F ' *\\| *' '$5 ~ /@ref/ { sub(/.*::/, "", $5); print $4 "|" $2 "|" $5 }' "$page")
[[ $(wc -l <<< "$references") -gt 20 && $(wc -l <<< "$rows") -gt 20 ]] ||
  { echo "found next to nothing"; exit 1; }

wrong=$(
  comm -23 <(echo "$references") <(sed 's/|[^|]*$//' <<< "$rows" | sort -u) |
    sed "s|^|no row in ${page##*/} for |"
  while IFS='|' read -r header _ name; do
    if [[ ! -f $header ]]; then
      echo "there is no $header"
    elif ! sed 's|//.*||' "$header" | grep -w "$name" > /dev/null; then
      echo "$header has no $name"
    fi
  done <<< "$rows"
)
if [[ $wrong ]]; then
  echo "$wrong"
  exit 1
fi
echo "$(wc -l <<< "$references") references of the headers, all in $(wc -l <<< "$rows") rows"
