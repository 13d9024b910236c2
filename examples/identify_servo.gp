# Draws an identified servo: reads identify_servo.csv in the current directory and writes
# identify_servo.png beside it. Columns are taken by name.

log = "identify_servo.csv"
set datafile separator ","
set datafile columnheaders

# ---- Look: that of hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"
ink = "#222222"; grey = "#666666"; pale = "#B0B0B0"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set key samplen 2.5 reverse Left textcolor rgb ink horizontal outside top center

degrees(name) = column(name) * 180 / pi
stats log using (column("time_s")) name "time" nooutput

set terminal pngcairo size 1200,800 font "DejaVu Sans,11"
set output "identify_servo.png"
set multiplot title "Servo: commanded, measured and fitted angle" font "DejaVu Sans Bold,14"
set lmargin at screen 0.08; set rmargin at screen 0.98
set xrange [0:time_max]

set tmargin at screen 0.88; set bmargin at screen 0.36
set ylabel "angle [deg]"; set format x ""
plot log using (column("time_s")):(degrees("command_rad")) with steps lw 1.5 lc rgb pale \
       title "commanded", \
     "" using (column("time_s")):(degrees("angle_rad")) with points pt 7 ps 0.35 lc rgb blue \
       title "measured", \
     "" using (column("time_s")):(degrees("fit_rad")) with lines lw 1.5 lc rgb red title "fitted"

set tmargin at screen 0.31; set bmargin at screen 0.08
set ylabel "measured - fitted [deg]"; set xlabel "time [s]"; set format x "%g"; unset key
plot log using (column("time_s")):(degrees("angle_rad") - degrees("fit_rad")) with points pt 7 \
       ps 0.3 lc rgb ink
