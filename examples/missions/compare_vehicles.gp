# Draws the comparison of vehicles. Reads compare_vehicles.csv and vehicle_*/hybrid_mission.csv in the
# current directory and writes compare_vehicles.png there. Reads columns by name.

table = "compare_vehicles.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
ink = "#222222"; grey = "#666666"
array colour[6] = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"]
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set style fill solid 0.8 noborder

stats table using (column("mass_kg")) name "all" nooutput
count = int(all_records)
array name[count]
do for [i = 1:count] {
  stats table every ::i-1::i-1 using (name[i] = strcol("vehicle"), 0) nooutput
}
flight(i) = sprintf("vehicle_%d/hybrid_mission.csv", i)
error(x) = 1000 * sqrt((column("position_m_x") - column("reference_m_x"))**2 \
  + (column("position_m_y") - column("reference_m_y"))**2 \
  + (column("position_m_z") - column("reference_m_z"))**2)
lean(x) = 180 / pi * acos(1 - 2 * (column("orientation_x")**2 + column("orientation_y")**2))
shade(i) = colour[(i - 1) % 6 + 1]

set terminal pngcairo size 1200,900 font "DejaVu Sans,11"
set output "compare_vehicles.png"
set multiplot title "Full actuation against leaning: the same mission" font "DejaVu Sans Bold,14"
set lmargin at screen 0.07; set rmargin at screen 0.98
set key at screen 0.5, screen 0.955 center horizontal width 2
set yrange [0:*]

set tmargin at screen 0.93; set bmargin at screen 0.70
set ylabel "position error [mm]" offset 1,0; set format x ""
plot for [i = 1:count] flight(i) using "time_s":(error(0)) with lines lw 1.5 lc rgb shade(i) \
  title name[i]
unset key

set tmargin at screen 0.66; set bmargin at screen 0.45
set ylabel "lean [deg]" offset 1,0; set format x "%g"; set xlabel "time [s]" offset 0,0.5
plot for [i = 1:count] flight(i) using "time_s":(lean(0)) with lines lw 1.5 lc rgb shade(i)

unset xlabel; set tmargin at screen 0.36; set bmargin at screen 0.07
set boxwidth 0.7; unset xtics
do for [p = 1:4] {
  set lmargin at screen 0.07 + 0.245 * (p - 1); set rmargin at screen 0.24 + 0.245 * (p - 1)
  key = word("air_rmse_m ground_rmse_m flight_power_w ground_power_w", p)
  factor = p < 3 ? 1000 : 1
  set title (p == 1 ? "RMSE in the air [mm]" : p == 2 ? "RMSE on the ground [mm]" : \
    p == 3 ? "power in the air [W]" : "power on the ground [W]")
  unset ylabel
  set yrange [*:*]; largest_max = 1
  stats table using (factor * column(key)) name "largest" nooutput
  set yrange [0:1.15 * largest_max]
  plot [0.4:count + 0.6] for [i = 1:count] table every ::i-1::i-1 using (i):(factor * column(key)) with boxes \
         lc rgb shade(i), \
       for [i = 1:count] "" every ::i-1::i-1 \
         using (i):(factor * column(key)):(sprintf("%.3g", factor * column(key))) \
         with labels offset 0,0.6 textcolor rgb ink
}
unset multiplot
