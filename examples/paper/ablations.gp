# Draws the ablations. Reads ablations.csv in the current directory and writes ablations.png there.
# Reads columns by name.

set datafile separator ","
set datafile columnheaders
blue = "#0072B2"; red = "#D55E00"; green = "#009E73"; ink = "#222222"; grey = "#666666"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid ytics back lt 1 lc rgb "#DDDDDD" lw 0.5
set style fill solid noborder
set boxwidth 0.27

ours(value) = strcol("flown_by") eq "plant" ? value : NaN
theirs(value) = strcol("flown_by") eq "plant" ? NaN : value
place(bar) = column("number") + 0.27 * (bar - 2)
mm(name) = 1e3 * column(name)
array errors[3] = ["air", "ground", "mission"]
array colours[3] = [blue, red, green]

set terminal pngcairo size 1200,820 font "DejaVu Sans,11"
set output "ablations.png"
set multiplot title "Hybrid mission with one part changed at a time (bars: our plant, marks: \
MuJoCo)" font "DejaVu Sans Bold,14"
stats "ablations.csv" using (column("number")) name "all" nooutput
set xrange [-0.6:all_max + 0.6]
set lmargin at screen 0.075; set rmargin at screen 0.985; set logscale y
set tmargin at screen 0.9; set bmargin at screen 0.55
set ylabel "RMSE [mm]"; set yrange [1:200]; set format x ""; set xtics 1
set key at screen 0.5, 0.925 center horizontal
plot for [bar = 1:3] "ablations.csv" using (place(bar)):(ours(mm(errors[bar]."_rmse_m"))) \
       with boxes lc rgb colours[bar] title errors[bar], \
     for [bar = 1:3] "" using (place(bar)):(theirs(mm(errors[bar]."_rmse_m"))) \
       with points pt 2 ps 1.1 lc rgb ink notitle
set tmargin at screen 0.52; set bmargin at screen 0.2
set ylabel "power on the ground [W]"; set yrange [10:1000]; unset key
set boxwidth 0.6; set xtics rotate by 35 right noenhanced; set format x "%g"
plot "ablations.csv" using (place(2)):(ours(column("ground_power_w"))):xticlabels(1) \
       with boxes lc rgb "#E69F00" notitle, \
     "" using (place(2)):(theirs(column("ground_power_w"))) with points pt 2 ps 1.1 lc rgb ink notitle
unset multiplot
