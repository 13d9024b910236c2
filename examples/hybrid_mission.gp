# Draws the hybrid mission: reads hybrid_mission.csv in the current directory and writes the
# pictures beside it. Columns are taken by name, and whatever depends on the run (the phases, the
# means, the ranges, the windows that are enlarged) is found in the data.

log = "hybrid_mission.csv"
set datafile separator ","
set datafile columnheaders

# ---- Look: the colour-blind safe palette of Okabe and Ito, one colour for one meaning
blue = "#0072B2"; red = "#D55E00"; green = "#009E73"; purple = "#CC79A7"
ink = "#222222"; grey = "#666666"; pale = "#B0B0B0"; sand = "#F6DDB8"
array axis_name[3] = ["x", "y", "z"]
array axis_colour[3] = [blue, red, green]
array rotor_name[4] = ["1 right", "2 left", "3 front", "4 back"]
array rotor_colour[4] = [blue, red, green, purple]
array phase_name[6] = ["rest", "take-off", "hover", "figure eight in the air", "landing", \
                       "figure eight on the ground"]
array phase_colour[6] = ["#E2E2E2", "#EFE9F4", "#FFFFFF", "#DFEDF7", "#EFE9F4", "#FAECD6"]
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set style fill solid noborder
set style line 1 lw 1.5; set style line 2 lw 2
set key horizontal samplen 2.5 reverse Left width 1 textcolor rgb ink
title_font = "DejaVu Sans Bold,14"

picture(name, height) = sprintf("set terminal pngcairo size 1200,%d font 'DejaVu Sans,11'; \
  set output '%s.png'", height, name)
# Panels one below the other that share the time axis, from the left margin to `right`.
panels(rows, right, title) = sprintf("set multiplot layout %d,1 margins 0.08,%g,0.08,0.88 \
  spacing 0,0.03 title \"%s\" font '%s' offset 0,-0.3", rows, right, title, title_font)
multi(title) = sprintf("set multiplot title \"%s\" font '%s' offset 0,-0.3", title, title_font)
end_multi = "unset multiplot; set lmargin -1; set rmargin -1; set tmargin -1; set bmargin -1; \
  unset title; set xtics auto; set xrange [0:run_max]; set autoscale y; \
  set key on inside maxrows auto"
with_times = "set xlabel 'time [s]'; set format x '%g'"
no_times = "unset xlabel; set format x ''"

# ---- Columns; where a function needs no argument, gnuplot still wants one
t(_) = column("time_s")
in(phase) = column("phase") == phase
only(condition, value) = condition ? value : NaN
x(of) = column(of."_m_x"); y(of) = column(of."_m_y"); z(of) = column(of."_m_z")
error_mm(a) = 1e3 * (column("position_m_".axis_name[a]) - column("reference_m_".axis_name[a]))
distance_mm(_) = sqrt(error_mm(1)**2 + error_mm(2)**2 + error_mm(3)**2)
touching(_) = column("external_force_n_z") > 0.1  # the plant's own force of the ground
tilt_deg(of, rotor) = column(sprintf("tilt_%s_rad_%d", of, rotor)) * 180 / pi
speed(rotor) = column(sprintf("rotor_speed_radps_%d", rotor))
mean_speed(_) = (speed(1) + speed(2) + speed(3) + speed(4)) / 4

# ---- Where each phase starts, and when the controller changes its contact mode
array start[64]; array kind[64]; array change[64]
phases = 0; changes = 0; now = NaN; mode = NaN
on_phase(p) = p == now ? p : \
  (phases = phases + 1, start[phases] = t(0), kind[phases] = p + 1, now = p)
on_mode(m) = (m == 1 - mode ? (changes = changes + 1, change[changes] = t(0)) : 0, mode = m)
stats log using (on_phase(column("phase"))):(on_mode(column("on_ground"))) nooutput
stats log using (t(0)) name "run" nooutput
start[phases + 1] = run_max

# Names stand above the uppermost panel, those of short phases a line higher: no overlap.
shade_phases = "do for [i = 1:phases] { \
  set object i rectangle from first start[i], graph 0 to first start[i+1], graph 1 \
    behind fillstyle solid noborder fillcolor rgb phase_colour[kind[i]] }"
name_phases = "do for [i = 1:phases] { \
  set label i phase_name[kind[i]] at first (start[i] + start[i+1]) / 2, graph 1 center \
    offset 0, (start[i+1] - start[i] < 0.035 * run_max ? 1.5 : 0.6) font ',9' textcolor rgb grey }"
no_names = "do for [i = 1:phases] { unset label i }"

# ---- 3-D: the reference wide and pale below, the flown way thin above
stats log using (x("position")):(y("position")) name "plan" nooutput
eval picture("trajectory_3d", 800)
set title "Flown trajectory of the centre of mass" font title_font offset 0,-1.5
set key at screen 0.5,0.08 center maxrows 1
set view 62,32,1.75; set view equal xyz; set xyplane at 0; set border 127 + 256 + 512 lc rgb pale
set xrange [plan_min_x - 0.2 : plan_max_x + 0.2]; set yrange [plan_min_y - 0.2 : plan_max_y + 0.2]
set zrange [0:*]
set xlabel "x [m]" offset 0,-0.5; set ylabel "y [m]" offset 1,-0.5; set zlabel "z [m]" rotate
set xtics 0.5 offset 0,-0.3; set ytics 0.5 offset 0.3,-0.2; set ztics 0.5
splot log using (x("reference")):(y("reference")):(z("reference")) with lines \
        lc rgb "#CFCFCF" lw 7 title "reference", \
      "" using (only(!in(3) && !in(5), x("position"))):(y("position")):(z("position")) \
        with lines lc rgb ink lw 2 title "take-off, hover, landing", \
      "" using (only(in(3), x("position"))):(y("position")):(z("position")) \
        with lines ls 2 lc rgb blue title "in the air", \
      "" using (only(in(5), x("position"))):(y("position")):(z("position")) \
        with lines ls 2 lc rgb red title "on the ground"
unset title; set border 3 lc rgb grey; set key maxrows auto inside
set xtics auto offset 0,0; set ytics auto offset 0,0; set ylabel offset 0,0
set xlabel offset 0,0.3; set xrange [0:run_max]; set autoscale y
eval shade_phases

# ---- Tracking error
stats log using (only(in(3), distance_mm(0)**2)) name "air" nooutput
stats log using (only(in(5), distance_mm(0)**2)) name "ground" nooutput
eval picture("tracking_error", 1000)
eval panels(3, 0.975, "Tracking error: flown minus reference position, world frame")
eval name_phases; eval no_times
set key bottom right
set ylabel "horizontal error [mm]"
plot for [a = 1:2] log using (t(0)):(error_mm(a)) with lines ls 1 lc rgb axis_colour[a] \
  title axis_name[a]
eval no_names
set ylabel "vertical error [mm]"
plot log using (t(0)):(error_mm(3)) with lines ls 1 lc rgb axis_colour[3] title axis_name[3]
eval with_times
set ylabel "distance to reference [mm]"; set logscale y; set yrange [0.1:*]
plot log using (t(0)):(distance_mm(0)) with lines ls 1 lc rgb ink notitle, \
     "" using (t(0)):(only(in(3), sqrt(air_mean))) with lines lw 3 lc rgb blue \
       title sprintf("RMSE in the air %.1f mm (paper: 52 mm)", sqrt(air_mean)), \
     "" using (t(0)):(only(in(5), sqrt(ground_mean))) with lines lw 3 lc rgb red \
       title sprintf("RMSE on the ground %.1f mm (paper: 145 mm)", sqrt(ground_mean))
unset multiplot; unset logscale y; set autoscale y

# ---- Height and contact: the whole run, below it each change of the contact mode enlarged
eval picture("height_and_contact", 900)
eval multi("Height of the centre of mass and contact with the ground")
set lmargin at screen 0.08; set rmargin at screen 0.975
set tmargin at screen 0.88; set bmargin at screen 0.5
eval name_phases; eval with_times
set key at screen 0.5,0.03 center maxrows 1
set ylabel "height [m]"; set yrange [0:*]; set y2range [0:1]
plot log using (t(0)):(column("on_ground") * 0.05) axes x1y2 with fillsteps lc rgb sand \
       title "controller's contact mode: on the ground", \
     "" using (t(0)):(z("reference")) with lines lc rgb pale lw 5 title "reference", \
     "" using (t(0)):(only(!touching(0), z("position"))) with lines ls 2 lc rgb blue \
       title "flown, wheels free", \
     "" using (t(0)):(only(touching(0), z("position"))) with lines ls 2 lc rgb red \
       title "flown, wheels touch"
eval no_names; unset object
set tmargin at screen 0.41; set bmargin at screen 0.14; set autoscale y
do for [i = 1:changes > 4 ? 4 : changes] {
  set lmargin at screen 0.08 + (i - 1) * 0.23; set rmargin at screen 0.08 + (i - 1) * 0.23 + 0.205
  set xrange [change[i] - 0.5 : change[i] + 1]; set xtics 0.5
  set title sprintf("mode changes at %.2f s", change[i]) offset 0,-0.6
  if (i == 1) { set ylabel "height [mm]" } else { unset ylabel }
  plot log using (t(0)):(column("on_ground")) axes x1y2 with fillsteps lc rgb sand notitle, \
     "" using (t(0)):(1e3 * z("reference")) with lines lc rgb pale lw 5 notitle, \
     "" using (t(0)):(only(!touching(0), 1e3 * z("position"))) with lines ls 2 lc rgb blue notitle, \
     "" using (t(0)):(only(touching(0), 1e3 * z("position"))) with lines ls 2 lc rgb red notitle
}
eval end_multi; eval shade_phases

# ---- External wrench. The estimate is a low-pass of the truth: ranges that fit the estimate keep
# it readable, and only the truth's contact impacts are cut.
eval picture("external_wrench", 1300)
eval panels(6, 0.975, "External wrench in the body frame: estimated (dark), true (pale, impacts cut)")
eval name_phases; eval no_times
set key top center
do for [i = 1:6] {
  a = i > 3 ? i - 3 : i
  what = (i > 3 ? "torque_nm_" : "force_n_").axis_name[a]
  stats log using (column("estimated_".what)) name "span" nooutput
  set yrange [span_min - 0.2 * (span_max - span_min) : span_max + 0.2 * (span_max - span_min)]
  set ylabel (i > 3 ? "M_".axis_name[a]." [N m]" : "F_".axis_name[a]." [N]")
  if (i == 6) { eval with_times }
  plot log using (t(0)):(column("external_".what)) with lines lw 3 lc rgb pale title "true", \
       "" using (t(0)):(column("estimated_".what)) with lines ls 1 lc rgb axis_colour[a] \
         title "estimated"
  eval no_names
}
unset multiplot; set autoscale y

# ---- Tilt angles; beside each the two seconds around its largest servo lag
eval picture("tilt_angles", 1200)
eval multi("Tilt angles of the arms")
set key at screen 0.5,0.025 center
eval name_phases; eval no_times
do for [r = 1:4] {
  stats log using (t(0)):(abs(tilt_deg("command", r) - tilt_deg("true", r))) name "lag" nooutput
  set tmargin at screen 1.11 - 0.205 * r; set bmargin at screen 0.93 - 0.205 * r
  if (r == 4) { eval with_times }
  do for [zoom = 0:1] {
    set lmargin at screen zoom ? 0.74 : 0.08; set rmargin at screen zoom ? 0.975 : 0.68
    if (zoom) { set xrange [lag_pos_max_y - 1 : lag_pos_max_y + 1]; unset ylabel } \
    else { set xrange [0:run_max]; set ylabel rotor_name[r]." [deg]" }
    plot log using (t(0)):(tilt_deg("command", r)) with lines lw 3 lc rgb pale \
           title "commanded", \
         "" using (t(0)):(tilt_deg("true", r)) with lines ls 2 lc rgb rotor_colour[r] \
           title "true", \
         "" using (t(0)):(tilt_deg("model", r)) with lines ls 1 dt 2 lc rgb ink \
           title "modelled by the controller"
    eval no_names; unset key
  }
}
eval end_multi

# ---- Rotor speeds
eval picture("rotor_speeds", 900)
eval panels(2, 0.975, "Rotor speeds")
eval name_phases; eval no_times
set key bottom center
set ylabel "speed [rad/s]"; set yrange [0:*]
plot for [r = 1:4] log using (t(0)):(speed(r)) with lines ls 1 lc rgb rotor_colour[r] \
  title rotor_name[r]
eval no_names; eval with_times
set ylabel "speed minus mean of the four [rad/s]"; set autoscale y
plot for [r = 1:4] log using (t(0)):(speed(r) - mean_speed(0)) with lines ls 1 \
  lc rgb rotor_colour[r] title rotor_name[r]
unset multiplot

# ---- Power: means over the two figure eights, as the paper's
power(_) = column("power_w")
stats log using (only(in(3), power(0))) name "air" nooutput
stats log using (only(in(5), power(0))) name "ground" nooutput
paper_air = 653.64; paper_ground = 47.38
eval picture("power", 800)
eval panels(1, 0.975, sprintf("Electrical power: driving takes %.1f %% of flying (paper: %.1f %%)", \
  100 * ground_mean / air_mean, 100 * paper_ground / paper_air))
eval name_phases
set key at screen 0.975,0.02 right
set ylabel "power [W]"; set yrange [0:*]
middle(phase) = (only(in(phase), t(0)))
plot log using (t(0)):(power(0)) with lines ls 1 lc rgb pale title "power", \
     "" using (t(0)):(only(in(3), air_mean)) with lines lw 3 lc rgb blue \
       title sprintf("mean in the air %.1f W", air_mean), \
     "" using (t(0)):(only(in(5), ground_mean)) with lines lw 3 lc rgb red \
       title sprintf("mean on the ground %.1f W", ground_mean), \
     paper_air lc rgb blue dt 2 title sprintf("paper %.2f W", paper_air), \
     paper_ground lc rgb red dt 2 title sprintf("paper %.2f W", paper_ground)
eval no_names
unset multiplot; set autoscale y

# ---- Solve times: when, and how many ticks take longer (log axes: a few ticks are preempted)
eval picture("solve_times", 1000)
eval multi("Time of the controller's solve")
set lmargin at screen 0.08; set rmargin at screen 0.975
set tmargin at screen 0.88; set bmargin at screen 0.52
eval name_phases; eval with_times
set key top right; set logscale y; set yrange [1:20000]; set ylabel "time [{/Symbol m}s]"
plot log using (t(0)):(column("prepare_us")) with points pt 7 ps 0.3 lc rgb blue notitle, \
     "" using (t(0)):(column("feedback_us")) with points pt 7 ps 0.3 lc rgb red notitle, \
     NaN with points pt 7 lc rgb blue title "prepare (before the measurement)", \
     NaN with points pt 7 lc rgb red title "feedback (measurement to command)"
eval no_names; unset object
set tmargin at screen 0.43; set bmargin at screen 0.09
set xrange [1:20000]; set logscale x; set xlabel "time [{/Symbol m}s]"; set yrange [*:*]
stats log using (column("prepare_us")) name "prepare" nooutput
stats log using (column("feedback_us")) name "feedback" nooutput
eval end_multi
