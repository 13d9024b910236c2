# Draws a replayed flight. Reads replay_flight.csv in the current directory and writes
# replay_flight.png there. Reads columns by name.

log = "replay_flight.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"; green = "#009E73"
ink = "#222222"; grey = "#666666"; pale = "#B0B0B0"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set key samplen 1.5 reverse Left textcolor rgb ink horizontal top right

# ---- Columns. gnuplot functions need an argument: (_) marks an unused one
t(_) = column("time_s")
# Three times the standard deviation that the filter reports, as a norm over the axes.
band(name) = 3 * sqrt(column("deviation_".name."_x")**2 + column("deviation_".name."_y")**2 + \
                      column("deviation_".name."_z")**2)
size(name) = sqrt(column("error_".name."_x")**2 + column("error_".name."_y")**2 + \
                  column("error_".name."_z")**2)
judged = strstrt(system("head -n 1 ".log), "error_") > 0  # only with ground truth

set terminal pngcairo size 1200,1100 font "DejaVu Sans,11"
set output "replay_flight.png"
set multiplot layout 3,2 title "Replayed flight" font "DejaVu Sans Bold,14" \
  margins 0.08,0.975,0.06,0.93 spacing 0.1,0.085

# The path from above
set size ratio -1
set xlabel "x [m]"; set ylabel "y [m]"
plot log using (column("position_m_x")):(column("position_m_y")) with lines lw 1.2 \
  lc rgb blue notitle
set size noratio

set xlabel "time [s]"
set ylabel "height [m], speed [m/s]"
plot log using (t(0)):(column("position_m_z")) with lines lw 1.2 lc rgb blue title "height", \
  "" using (t(0)):(sqrt(column("velocity_mps_x")**2 + column("velocity_mps_y")**2 + \
                        column("velocity_mps_z")**2)) with lines lc rgb pale title "speed"

# Errors, and three times the standard deviation that the filter reports
set yrange [0:*]
set ylabel "position error [mm]"
if (judged) {
  plot log using (t(0)):(1e3 * size("position_m")) with lines lc rgb red title "error", \
    "" using (t(0)):(1e3 * band("position_m")) with lines lw 1.2 lc rgb ink title "3 deviations"
} else {
  plot log using (t(0)):(1e3 * band("position_m")) with lines lw 1.2 lc rgb ink title "3 deviations"
}
set ylabel "attitude error [deg]"
if (judged) {
  plot log using (t(0)):(180 / pi * size("orientation_rad")) with lines lc rgb red title "error", \
    "" using (t(0)):(180 / pi * band("orientation_rad")) with lines lw 1.2 lc rgb ink \
      title "3 deviations"
} else {
  plot log using (t(0)):(180 / pi * band("orientation_rad")) with lines lw 1.2 lc rgb ink \
    title "3 deviations"
}

set yrange [*:*]
set ylabel "gyro bias [rad/s]"
plot for [i = 1:3] log using (t(0)):(column("gyro_bias_radps_".word("x y z", i))) with lines lw 1.2 \
  lc rgb word(blue." ".red." ".green, i) title word("x y z", i)

set logscale y
set format y "10^{%T}"
set yrange [0.01:1e4]
set ylabel "NIS of the last pose"
plot log using (t(0)):(column("nis")) with dots lc rgb ink notitle, \
  6 with lines lc rgb pale title "expected mean"
