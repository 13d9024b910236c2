# Draws a Monte Carlo run. Reads monte_carlo.csv in the current directory and writes monte_carlo.png
# there. Reads columns by name.

flights = "monte_carlo.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"; ink = "#222222"; grey = "#666666"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set style fill solid 0.8 noborder
unset key

set terminal pngcairo size 1200,800 font "DejaVu Sans,11"
set output "monte_carlo.png"
set multiplot layout 2,2 title "Vehicles of the Monte Carlo run" font "DejaVu Sans Bold,14"
set ylabel "vehicles"; set yrange [0:*]

# Forty bins from the smallest to the largest value, without diverged vehicles
good(name) = column("verdict") == 0 ? column(name) : NaN
histogram = "stats flights using (good(name)) name 'of' nooutput; \
  width = of_max > of_min ? (of_max - of_min) / 40.0 : 1e-6; set boxwidth width * scale * 0.9; \
  plot flights using (scale * (of_min + width * (floor((good(name) - of_min) / width) + 0.5))):(1) \
    smooth frequency with boxes lc rgb blue"

name = "air_rmse_m"; scale = 1000; set xlabel "position RMSE in the air [mm]"
eval histogram
name = "ground_rmse_m"; set xlabel "position RMSE on the ground [mm]"
eval histogram
name = "touchdown_speed_mps"; scale = 1; set xlabel "fastest touchdown [m/s]"
eval histogram
name = "ground_power_w"; set xlabel "power on the ground [W]"
eval histogram
unset multiplot
