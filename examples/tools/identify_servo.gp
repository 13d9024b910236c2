# Draws an identified servo. Reads identify_servo.csv in the current directory and writes
# identify_servo.png there. Reads columns by name.

log = "identify_servo.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"
ink = "#222222"; grey = "#666666"; pale = "#B0B0B0"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set key samplen 2.5 reverse Left textcolor rgb ink

# ---- Columns. gnuplot functions need an argument: (_) marks an unused one
t(_) = column("time_s")
degrees(name) = column(name) * 180 / pi
residual(_) = degrees("angle_rad") - degrees("fit_rad")

# ---- The largest jump of the command
last = NaN; largest = 0; jump = 0
on_command(c) = (abs(c - last) > largest ? (largest = abs(c - last), jump = t(0)) : 0, last = c)
stats log using (t(0)):(on_command(column("command_rad"))) name "run" nooutput

set terminal pngcairo size 1200,900 font "DejaVu Sans,11"
set output "identify_servo.png"
set multiplot title "Servo: commanded, measured and fitted angle" \
  font "DejaVu Sans Bold,14" offset 0,-0.3
set xlabel "time [s]"
angles = "plot log using (t(0)):(degrees('command_rad')) with steps lw 3 lc rgb pale \
    title 'commanded', \
  '' using (t(0)):(degrees('angle_rad')) with points pt 7 ps size lc rgb blue title 'measured', \
  '' using (t(0)):(degrees('fit_rad')) with lines lw 2 lc rgb red title 'fitted'"

# The whole log
set lmargin at screen 0.07; set rmargin at screen 0.975
set tmargin at screen 0.93; set bmargin at screen 0.5
set xrange [0:run_max_x]; set ylabel "angle [deg]"
set key on vertical maxrows 1 at screen 0.5, 0.025 center
size = 0.4
eval angles
unset key

# One step enlarged
set rmargin at screen 0.48; set tmargin at screen 0.41; set bmargin at screen 0.12
set xrange [jump - 0.1 : jump + 0.4]; set ylabel "largest step [deg]"
size = 0.6
eval angles

# Residual
set lmargin at screen 0.57; set rmargin at screen 0.975
set xrange [0:run_max_x]; set ylabel "measured - fitted [deg]"
plot log using (t(0)):(residual(0)) with points pt 7 ps 0.25 lc rgb ink
