# Draws the force and torque envelopes of a vehicle. Reads envelope.csv in the current directory and
# writes check_vehicle.png there. Reads columns by name.

log = "envelope.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"
ink = "#222222"; grey = "#666666"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set key samplen 2.5 reverse Left textcolor rgb ink on vertical maxrows 1 at screen 0.5, 0.03 center
set style fill transparent solid 0.15

array across[3] = ["x", "x", "y"]
array up[3] = ["y", "z", "z"]
what = "force"; unit = "n"
in(p, value) = column("plane") == p ? value : NaN
given(side) = column(sprintf("%s_%s_%s", what, side, unit))
limit(side, end) = column(sprintf("%s_%s_%s_%s", what, side, end, unit))

set terminal pngcairo size 1200,860 font "DejaVu Sans,11"
set output "check_vehicle.png"
set multiplot title "What the actuators give: force without torque (above), torque in hover (below)" \
  font "DejaVu Sans Bold,14" offset 0,-0.3
set size ratio -1
do for [row = 0:1] {
  what = row == 0 ? "force" : "torque"; unit = row == 0 ? "n" : "nm"
  set xrange [*:*]; set yrange [*:*]
  stats log using (abs(given("a"))):(abs(given("b"))) name "all" nooutput
  most = 1.05 * (all_max_x > all_max_y ? all_max_x : all_max_y)
  set xrange [-most:most]; set yrange [-most:most]
  do for [p = 0:2] {
    set lmargin at screen 0.07 + 0.32 * p; set rmargin at screen 0.33 + 0.32 * p
    set tmargin at screen 0.92 - 0.44 * row; set bmargin at screen 0.57 - 0.44 * row
    set xlabel sprintf(row == 0 ? "F_%s [N]" : "M_%s [N m]", across[p + 1]) offset 0,0.4
    set ylabel sprintf(row == 0 ? "F_%s [N]" : "M_%s [N m]", up[p + 1]) offset 1,0
    stats log using (in(p, limit("a", "min"))):(in(p, limit("a", "max"))) name "a" nooutput
    stats log using (in(p, limit("b", "min"))):(in(p, limit("b", "max"))) name "b" nooutput
    set object 1 rectangle from first a_min_x, first b_min_x to first a_max_y, first b_max_y \
      front fillstyle empty border lc rgb red lw 1.5
    plot log using (in(p, given("a"))):(in(p, given("b"))) with filledcurves closed lc rgb blue \
           notitle, \
         "" using (in(p, given("a"))):(in(p, given("b"))) with lines lw 2 lc rgb blue \
           title "given by the actuators", \
         NaN with lines lw 1.5 lc rgb red title "limits of the controller"
    unset key
  }
}
