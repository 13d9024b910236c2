# Draws the fit of an identified vehicle. Reads identify_vehicle.csv in the current directory and
# writes identify_vehicle.png there. Reads columns by name.

log = "identify_vehicle.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"
ink = "#222222"; grey = "#666666"; pale = "#B0B0B0"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set key samplen 2.5 reverse Left textcolor rgb ink

force(axis) = "specific_force_mps2_" . axis
turning(axis) = "angular_acceleration_radps2_" . axis
residual(name) = column(name) - column("fitted_" . name)

stats log using (column("time_s")):(residual(force("z"))) name "run" nooutput
set terminal pngcairo size 1400,1000 font "DejaVu Sans,11"
set output "identify_vehicle.png"
set multiplot title "Vehicle: measured and fitted specific force and angular acceleration" \
  font "DejaVu Sans Bold,14" offset 0,-0.3
set xrange [run_min_x:run_max_x]

# Rows x, y, z; each with fit (left) and residual (right), for force and angular acceleration
do for [i = 0:2] {
  axis = word("x y z", i + 1)
  top = 0.93 - 0.285 * i
  set tmargin at screen top; set bmargin at screen top - 0.215
  set xlabel (i == 2 ? "time [s]" : "")
  do for [j = 0:1] {
    name = j == 0 ? force(axis) : turning(axis)
    unit = j == 0 ? "[m/s^2]" : "[rad/s^2]"
    left = 0.06 + 0.49 * j
    set lmargin at screen left; set rmargin at screen left + 0.235
    set ylabel (j == 0 ? "specific force " : "ang. acceleration ") . axis . " " . unit offset 1
    if (i == 0 && j == 0) {
      set key on vertical maxrows 1 at screen 0.5, 0.025 center
    } else {
      unset key
    }
    plot log using (column("time_s")):(column(name)) with points pt 7 ps 0.25 lc rgb blue title "measured", \
      '' using (column("time_s")):(column("fitted_" . name)) with lines lw 1 lc rgb red title "fitted", \
      NaN with points pt 7 ps 0.25 lc rgb ink title "measured - fitted"
    unset key
    set lmargin at screen left + 0.285; set rmargin at screen left + 0.44
    set ylabel "residual " . unit offset 1
    plot log using (column("time_s")):(residual(name)) with points pt 7 ps 0.2 lc rgb ink notitle
  }
}
