# Draws the fit of a rotor. Reads fit_rotor.csv in the current directory and writes fit_rotor.png
# there. Reads columns by name; draws torque and power if their columns exist.

log = "fit_rotor.csv"
header = system("head -n 1 ".log)
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"
ink = "#222222"; grey = "#666666"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set key samplen 2.5 reverse Left textcolor rgb ink

speed(_) = column("speed_radps")
rows = 1 + (strstrt(header, "torque_nm") > 0) + (strstrt(header, "power_w") > 0)
set terminal pngcairo size 1200,100 + 330 * rows font "DejaVu Sans,11"
set output "fit_rotor.png"
set multiplot title "Rotor: measured and fitted" font "DejaVu Sans Bold,14" offset 0,-0.3

stats log using (speed(0)) name "speed" nooutput
set xrange [0 : 1.03 * speed_max]
title = 50.0 / (100 + 330 * rows)  # fraction of the height
height = (0.99 - title) / rows
row = 0

# A row with the measured points and the fit, and with the residuals. The fit is drawn as
# a + b speed^n through the smallest and largest value of the fit.
law = "stats log using (column(fit)) name 'fit' nooutput; \
  f(x) = fit_min + (fit_max - fit_min) * (x**n - speed_min**n) / (speed_max**n - speed_min**n); \
  set tmargin at screen 1 - title - row * height; \
  set bmargin at screen 1 - title - (row + 1) * height + 1.3 * title; \
  set xlabel 'speed [rad/s]'; \
  set lmargin at screen 0.07; set rmargin at screen 0.48; set ylabel label; \
  plot log using (speed(0)):(column(measured)) with points pt 7 ps 0.7 lc rgb blue \
      title 'measured', \
    [0 : speed_max] f(x) with lines lw 2 lc rgb red title 'fitted'; \
  set lmargin at screen 0.57; set rmargin at screen 0.975; \
  set ylabel 'measured - fitted '.unit; \
  plot log using (speed(0)):(column(measured) - column(fit)) with points pt 7 ps 0.7 lc rgb ink \
      notitle; \
  row = row + 1"
set key top left

n = 2; measured = "thrust_n"; fit = "thrust_fit_n"; unit = "[N]"; label = "thrust [N]"
eval law
if (strstrt(header, "torque_nm")) {
  measured = "torque_nm"; fit = "torque_fit_nm"; unit = "[N m]"; label = "torque [N m]"
  eval law
}
if (strstrt(header, "power_w")) {
  n = 3; measured = "power_w"; fit = "power_fit_w"; unit = "[W]"; label = "power [W]"
  eval law
}
