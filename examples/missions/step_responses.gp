# Draws the effect of tuning. Reads step_responses.csv in the current directory and writes
# step_responses.png there. Reads columns by name.

log = "step_responses.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"
ink = "#222222"; grey = "#666666"; pale = "#B0B0B0"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set key samplen 2.5 reverse Left textcolor rgb ink on vertical maxrows 1 at screen 0.5, 0.025 center

array knob_name[12] = ["allowed position", "allowed velocity", "allowed force", \
  "allowed force rate", "limit of force", "limit of force rate", "allowed orientation", \
  "allowed angular velocity", "allowed torque", "allowed torque rate", "limit of torque", \
  "limit of angular velocity"]
array factor[3] = [1, 0.5, 2]
array colour[3] = [pale, blue, red]
array meaning[3] = ["as it is", "halved", "doubled"]
turns = 0
set offsets 0, 0, graph 0.06, graph 0.03
shows(_) = turns ? column("heading_deg") : column("side_m")
shown(f, value) = column("factor") == f ? value : NaN
# Copies the rows of a knob, which is the first column, into a data block in memory.
take(k) = sprintf("load \"< echo '$knob << END'; grep -E '^(knob|%d),' %s; echo END\"", k, log)

set terminal pngcairo size 1200,1200 font "DejaVu Sans,11"
set output "step_responses.png"
set multiplot title "What tuning does: a step sideways (above) and a turn (below)" \
  font "DejaVu Sans Bold,14" offset 0,-0.3
do for [k = 0:11] {
  turns = k >= 6; row = k / 3; place = k % 3
  set lmargin at screen 0.065 + 0.32 * place; set rmargin at screen 0.335 + 0.32 * place
  set tmargin at screen 0.925 - 0.225 * row; set bmargin at screen 0.765 - 0.225 * row
  set title knob_name[k + 1] offset 0,-0.7
  set xrange [(turns ? 3.8 : 0.8):(turns ? 6.5 : 3.5)]
  set xlabel (row == 3 ? "time [s]" : "") offset 0,0.3
  set ylabel (place == 0 ? (turns ? "heading [deg]" : "way [m]") : "") offset 1,0
  eval take(k)
  plot for [i = 1:3] $knob using (column("time_s")):(shown(factor[i], shows(0))) with lines \
    lw (i == 1 ? 4 : 2) lc rgb colour[i] title meaning[i]
  unset key
}
