#!/usr/bin/env bash
# report_page.sh HYBRID_MISSION
# Flies, and opens the page about the flight in headless Chromium: every plot, the scene and all figures
# are drawn, wheel and pointer are answered, nothing is on the console; without WebGL all but the scene.
# Spoilt copies of the page are found out. 77, skipped, without Chromium or without the libraries that the page is made of.
set -euo pipefail

program=$1
script=$(dirname "${BASH_SOURCE[0]}")/report_page.js
chromium=$(command -v chromium || command -v chromium-browser || command -v google-chrome) ||
  { echo "skipped: Chromium is not installed (Debian: chromium)" && exit 77; }
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
PATH=/nowhere "$program" --output "$away" > "$away/figures.txt" 2> "$away/errors.txt"  # no gnuplot
if grep 'install the Debian package' "$away/errors.txt"; then
  echo "skipped: a library of the page is not installed"
  exit 77
fi

# What report_page.js sees, in the attributes of <html>, and lines of the console. Its notices on how fast
# pixels are read are the test's own doing.
look_at() {  # page, options of Chromium
  rm -rf "$away/profile"
  { sed '/^<\/body>$/,$d' "$1" && echo '<script>' && cat "$script" && echo '</script>'; } > "$away/looked_at.html"
  HOME=$away timeout 600 "$chromium" --headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader \
    --disable-dev-shm-usage --disable-quic --no-first-run --disable-background-networking \
    --disable-component-update --disable-sync --user-data-dir="$away/profile" \
    --window-size=1400,1000 --enable-logging=stderr --virtual-time-budget=5000 "${@:2}" \
    --dump-dom "file://$away/looked_at.html" > "$away/dom.html" 2> "$away/chromium.txt" || echo "Chromium failed"
  grep -o '<html lang[^>]*>' "$away/dom.html" || tail -n 20 "$away/chromium.txt"
  grep CONSOLE "$away/chromium.txt" | grep -v 'GPU stall due to ReadPixels' || true
}

failed=0
expect() {  # what for, what is seen, what should be
  [[ $2 == "$3" ]] && echo "ok: $1" && return
  printf 'FAILED: %s\n%s\n  instead of\n%s\n' "$@"
  failed=1
}
phases=$(awk -F, 'NR > 1 && $2 != phase { ++count; phase = $2 } NR == 2 { count = 1 }
  END { print count }' "$away/hybrid_mission.csv")
figures=$(grep -c '^[A-Za-z_0-9]*: ' "$away/figures.txt")
drawn() {  # plots, scene, answers
  echo "<html lang=\"en\" data-drawn=\"plots $1 scene $2 phases $phases figures $figures\" data-answers=\"$3\">"
}

page=$away/report.html
expect "everything is drawn" "$(look_at "$page")" "$(drawn 10 1 "scroll zoom phase time turn")"
expect "all but the scene without WebGL" "$(look_at "$page" --disable-3d-apis)" "$(drawn 10 0 "scroll zoom phase time")"
grep -q 'no WebGL, so' <(grep '<div id="scene"' "$away/dom.html") ||
  expect "the page says that it has no scene" "it does not" "it does"

spoilt() {  # what for, sed's command, what of it has to be seen
  sed "$2" "$page" > "$away/spoilt.html"
  ! cmp -s "$page" "$away/spoilt.html" || expect "$1: the copy differs" "it does not" "it does"
  local seen
  seen=$(look_at "$away/spoilt.html")
  [[ $seen == *"$3"* ]] && expect "found out: $1" 1 1 || expect "found out: $1" "$seen" "...$3..."
}
spoilt "lines that are not drawn" 's/^  context\.stroke();$//' 'plots 1 scene 1'
spoilt "a scene without its way" 's/^  addWay(.*;$//' 'scene 0'
spoilt "an error on the console" 's/^resize();$/console.error("spoilt"); &/' 'CONSOLE'
spoilt "an error in the script" 's/^resize();$/nobody(); &/' 'data-failed'
spoilt "plots that do not zoom" 's/^place\.call(zoom).*$//' 'answers="scroll phase time turn"'
spoilt "something from outside" 's|^<body>|&<img src="https://example.com/x.png">|' 'data-failed'
exit $failed
