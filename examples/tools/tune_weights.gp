# Draws the points of a search for weights: each error against the objective, and tracking against
# power. Reads tune_weights.csv in the current directory and writes tune_weights.png there. Reads
# columns by name.

log = "tune_weights.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"
ink = "#222222"; grey = "#666666"; pale = "#B0B0B0"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5

header = system("grep -v '^#' ".log." | head -n 1 | tr ',' ' '")
errors = ""
do for [name in header] { if (name[1:7] eq "factor_") { errors = errors." ".name[8:*] } }

ok(value) = column("lost") == 0 ? value : NaN  # without lost flights
stats log using (column("cost")) name "cost" nooutput
best = int(cost_index_min)

set terminal pngcairo size 1500,1050 font "DejaVu Sans,11"
set output "tune_weights.png"
set multiplot title "Weights tried: each allowed error times its factor, against the objective" \
  font "DejaVu Sans Bold,14" offset 0,-0.3
unset key
set logscale y
set format y "%g"
do for [i = 1:words(errors)] {
  name = word(errors, i)
  column_of = (i - 1) % 4; row_of = (i - 1) / 4
  set lmargin at screen 0.06 + 0.245 * column_of; set rmargin at screen 0.23 + 0.245 * column_of
  set tmargin at screen 0.93 - 0.3 * row_of; set bmargin at screen 0.72 - 0.3 * row_of
  set logscale x
  set xlabel "factor of ".name font ",9" noenhanced offset 0,0.4
  set ylabel (column_of == 0 ? "objective" : "") offset 1
  plot log using (column("factor_".name)):(ok(column("objective"))) with points pt 7 ps 0.5 lc rgb pale, \
    '' every ::best::best using (column("factor_".name)):(column("objective")) with points pt 7 ps 1.3 lc rgb red
}
unset logscale x
do for [i = 0:1] {
  power = word("flight_power_w ground_power_w", i + 1)
  set lmargin at screen 0.06 + 0.49 * i; set rmargin at screen 0.475 + 0.49 * i
  set tmargin at screen 0.33; set bmargin at screen 0.06
  set xlabel "power ".(i == 0 ? "in the air" : "on the ground")." [W]" offset 0,0.4
  set ylabel (i == 0 ? "RMSE of the mission [m]" : "")
  if (int(system("awk -F, 'NR == 2 {for (i = 1; i <= NF; ++i) if ($i == \"".power."\") c = i} NR > 2 && $c != \"nan\" {++n} END {print n + 0}' ".log)) > 0) {
    # The front: points that no other point beats in both.
    front = "< grep -v '^#' ".log." | awk -F, 'NR == 1 {for (i = 1; i <= NF; ++i) {if ($i == \"".power."\") p = i; if ($i == \"mission_rmse_m\") m = i; if ($i == \"lost\") l = i}} NR > 1 && $l == 0 && $p != \"nan\" {print $p \",\" $m}' | sort -t, -g | awk -F, 'BEGIN {print \"power,rmse\"} NR == 1 || $2 < least {least = $2; print}'"
    plot log using (column(power)):(ok(column("mission_rmse_m"))) with points pt 7 ps 0.5 lc rgb pale, \
      front using 1:2 with steps lw 2 lc rgb blue, \
      log every ::best::best using (column(power)):(column("mission_rmse_m")) with points pt 7 ps 1.3 lc rgb red
  }
}
unset multiplot
