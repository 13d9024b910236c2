# Draws the hybrid mission: reads hybrid_mission.csv in the current directory and writes the
# pictures beside it. Columns are taken by name, and whatever depends on the run (the phases, the
# means, the windows that are enlarged) is found in the data.

log = "hybrid_mission.csv"
set datafile separator ","
set datafile columnheaders

# ---- Look: the colour-blind safe palette of Okabe and Ito, one colour for one meaning
blue = "#0072B2"; red = "#D55E00"; green = "#009E73"; purple = "#CC79A7"
ink = "#222222"; grey = "#777777"; pale = "#A8A8A8"
array axis_name[3] = ["x", "y", "z"]
array axis_colour[3] = [blue, red, green]
array rotor_name[4] = ["1 (right)", "2 (left)", "3 (front)", "4 (back)"]
array rotor_colour[4] = [blue, red, green, purple]
array phase_name[6] = ["rest", "take-off", "hover", "figure eight in the air", "landing", \
                       "figure eight on the ground"]
array phase_colour[6] = ["#E4E4E4", "#EFE9F4", "#FFFFFF", "#DFEDF7", "#EFE9F4", "#FAECD6"]
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid lc rgb "#CCCCCC" lw 0.5 dt solid
set style fill solid noborder
set key horizontal samplen 2.5 textcolor rgb ink
title_font = "DejaVu Sans Bold,14"

picture(name, height) = sprintf("set terminal pngcairo size 1200,%d font 'DejaVu Sans,11'; \
  set output '%s.png'", height, name)
# Panels that share the time axis, under one title and the names of the phases.
panels(rows, columns, title) = sprintf("set multiplot layout %d,%d margins 0.08,0.975,0.1,0.87 \
  spacing 0.075,0.045 title \"%s\" font '%s' offset 0,-0.4; set key at screen 0.5,0.03 center", \
  rows, columns, title, title_font)
time_axis = "set xlabel 'time [s]'; set format x '%g'"
no_time_axis = "unset xlabel; set format x ''"

# ---- Columns
t(row) = column("time_s")
in(phase) = column("phase") == phase
only(condition, value) = condition ? value : NaN
error_mm(a) = 1e3 * (column("position_m_".axis_name[a]) - column("reference_m_".axis_name[a]))
distance_mm(row) = sqrt(error_mm(1)**2 + error_mm(2)**2 + error_mm(3)**2)
degrees_of(what, rotor) = column(sprintf("tilt_%s_rad_%d", what, rotor)) * 180 / pi
touching(row) = column("external_force_n_z") > 0.1  # true force of the ground, body z [N]

# ---- Where each phase starts, and when the controller changes its contact mode
array phase_start[64]; array phase_kind[64]; array change[64]
phases = 0; changes = 0; kind = NaN; mode = NaN
on_phase(time, p) = p == kind ? p : \
  (phases = phases + 1, phase_start[phases] = time, phase_kind[phases] = p, kind = p)
on_mode(time, m) = (mode == 1 - m ? (changes = changes + 1, change[changes] = time) : 0, mode = m)
stats log using (on_phase(t(0), column("phase"))):(on_mode(t(0), column("on_ground"))) nooutput
stats log using (t(0)) name "time" nooutput
phase_start[phases + 1] = time_max
set xrange [0:time_max]

do for [i = 1:phases] {
  set object i rectangle from first phase_start[i], graph 0 to first phase_start[i+1], graph 1 \
    behind fillstyle solid noborder fillcolor rgb phase_colour[phase_kind[i] + 1]
}
# The names stand above the uppermost panel, those of short phases a line higher: no overlap.
name_phases = "do for [i = 1:phases] { \
  set label i phase_name[phase_kind[i]+1] at first (phase_start[i] + phase_start[i+1]) / 2, graph 1 \
    center offset 0, (phase_start[i+1] - phase_start[i] < 0.035 * time_max ? 1.5 : 0.6) \
    font ',9' textcolor rgb grey }"
no_names = "do for [i = 1:phases] { unset label i }"

# ---- Tracking error
stats log using (only(in(3), distance_mm(0)**2)) name "air" nooutput
stats log using (only(in(5), distance_mm(0)**2)) name "ground" nooutput
@picture("tracking_error", 1000)
