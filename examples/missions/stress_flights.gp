# Draws the disturbances and recoveries. Reads stress_flights.csv and stress_flights_log.csv in the
# current directory and writes stress_flights.png there. Reads columns by name.

flights = "stress_flights.csv"
log = "stress_flights_log.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"; ink = "#222222"; grey = "#666666"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set style fill solid 0.8 noborder
set key at screen 0.5, 0.02 center horizontal samplen 1.5 textcolor rgb ink

set terminal pngcairo size 1200,900 font "DejaVu Sans,11"
set output "stress_flights.png"
set multiplot layout 2,2 title "What the vehicle recovered from" font "DejaVu Sans Bold,14" \
  margins 0.08,0.97,0.12,0.91 spacing 0.09,0.13

if_recovered(value) = column("recovered") > 0 ? value : NaN
if_lost(value) = column("recovered") > 0 ? NaN : value

set xlabel "time [s]"
set xrange [0:8]; set yrange [0:*]
set ylabel "distance from the reference [m]"
plot log using (column("time_s")):(if_recovered(column("distance_m"))) with points pt 7 ps 0.2 \
    lc rgb blue notitle, \
  log using (column("time_s")):(if_lost(column("distance_m"))) with points pt 7 ps 0.2 \
    lc rgb red notitle
set ylabel "angle from the reference [deg]"; set ytics 45
plot log using (column("time_s")):(if_recovered(column("angle_deg"))) with points pt 7 ps 0.2 \
    lc rgb blue notitle, \
  log using (column("time_s")):(if_lost(column("angle_deg"))) with points pt 7 ps 0.2 \
    lc rgb red notitle
set xlabel "lean at the beginning [deg]"; set xtics 45; set ytics auto
set xrange [-5:185]
set ylabel "body rate at the beginning [rad/s]"
set yrange [-0.3:*]
plot flights using (column("tilt_deg")):(if_recovered(column("rate_radps"))) with points pt 7 \
    ps 0.7 lc rgb blue title "recovered", \
  flights using (column("tilt_deg")):(if_lost(column("rate_radps"))) with points pt 9 ps 1.2 \
    lc rgb red title "not recovered"
unset key
set xrange [*:*]; set yrange [0:*]; set xtics auto
set xlabel "longest tick of a flight [us]"
set ylabel "time to recover [s]"
plot flights using (column("worst_tick_us")):(if_recovered(column("recovery_time_s"))) \
    with points pt 7 ps 0.7 lc rgb blue
unset multiplot
