# Draws the hybrid mission. Reads hybrid_mission.csv and solve_times.csv in the current directory
# and writes the pictures there. Reads columns by name. Computes from the data everything that
# depends on the run: rotors, phases, means, ranges and enlarged windows.

log = "hybrid_mission.csv"; times = "solve_times.csv"
set datafile separator ","
set datafile columnheaders

# ---- Style: the palette of Okabe and Ito, which colour-blind readers can distinguish
blue = "#0072B2"; red = "#D55E00"; green = "#009E73"; purple = "#CC79A7"
ink = "#222222"; grey = "#666666"; pale = "#B0B0B0"; sand = "#F6DDB8"
array axis_name[3] = ["x", "y", "z"]
array axis_colour[3] = [blue, red, green]
array rotor_colour[8] = [blue, red, green, purple, "#E69F00", "#56B4E9", "#8C6D1F", ink]
array phase_name[6] = ["rest", "take-off", "hover", "figure eight in the air", "landing", \
                       "figure eight on the ground"]
array phase_colour[6] = ["#E2E2E2", "#EFE9F4", "#FFFFFF", "#DFEDF7", "#EFE9F4", "#FAECD6"]
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#C8C8C8" lw 0.5
set style fill solid noborder
set style line 1 lw 1.5
set style line 2 lw 2
set key samplen 2.5 reverse Left textcolor rgb ink

# ---- Columns. gnuplot functions need an argument: (_) marks an unused one
t(_) = column("time_s")
in(phase) = column("phase") == phase
only(condition, value) = condition ? value : NaN
x(of) = column(of."_m_x"); y(of) = column(of."_m_y"); z(of) = column(of."_m_z")
error_mm(a) = 1e3 * (column("position_m_".axis_name[a]) - column("reference_m_".axis_name[a]))
distance_mm(_) = sqrt(error_mm(1)**2 + error_mm(2)**2 + error_mm(3)**2)
touching(_) = column("external_force_n_z") > 0.1  # ground force of the plant
tilt_deg(of, rotor) = column(sprintf("tilt_%s_rad_%d", of, rotor)) * 180 / pi
speed(rotor) = column(sprintf("rotor_speed_radps_%d", rotor))
header = system("head -n 1 ".log)
battery = strstrt(header, "voltage_v") > 0  # 1 if the vehicle's battery is known
# Copies the columns whose names match a regular expression into a data block in memory. For each
# curve, gnuplot reads all columns of its source again: some 75 times the whole log without this.
take(block, names) = sprintf("load \"< echo '%s << END'; cut -d , -f \
  $(head -n 1 %s | tr , '\\n' | grep -nxE '%s' | cut -d : -f 1 | paste -sd ,) %s; echo END\"", \
  block, log, names, log)
eval take("$motion", \
  "time_s|phase|on_ground|(position|reference)_m_.|external_force_n_z|power_w|voltage_v|wall_force_n|push_force_n")
rotors = 0
do for [i = 1:8] { if (strstrt(header, sprintf("rotor_speed_radps_%d", i))) { rotors = i } }
mean_speed(_) = (sum [i = 1:rotors] speed(i)) / rotors
power(_) = column("power_w")
prepare(_) = column("prepare_us"); feedback(_) = column("feedback_us")

# ---- Start of each phase, times when the controller changes its contact mode, means of the run
array start[512]; array kind[512]; array change[512]
phases = 0; changes = 0; flown = 0; driven = 0; now = NaN; mode = NaN
on_phase(p) = p == now ? p : (phases = phases + 1, start[phases] = t(0), kind[phases] = p + 1, \
  flown = (p == 3 ? 1 : flown), driven = (p == 5 ? 1 : driven), now = p)
on_mode(m) = (m == 1 - mode ? (changes = changes + 1, change[changes] = t(0)) : 0, mode = m)
stats times using (prepare(0)):(feedback(0)) name "solve" nooutput
stats $motion using (on_phase(column("phase"))):(on_mode(column("on_ground"))) nooutput
stats $motion using (t(0)) name "run" nooutput
stats $motion using (x("position")):(y("position")) name "plan" nooutput
air_mean_x = NaN; air_mean_y = NaN; ground_mean_x = NaN; ground_mean_y = NaN
if (flown) {
  stats $motion using (only(in(3), distance_mm(0)**2)):(power(0)) name "air" nooutput
}
if (driven) {
  stats $motion using (only(in(5), distance_mm(0)**2)):(power(0)) name "ground" nooutput
}
air_rmse = sqrt(air_mean_x); ground_rmse = sqrt(ground_mean_x)
start[phases + 1] = run_max

pushes = 0
if (strstrt(header, "push_force_n")) {
  stats $motion using (column("push_force_n")) name "push" nooutput
  pushes = push_max > 0
}

# ---- Pictures: title, and panels with margins in pixels. Every picture resets the settings.
picture(name, pixels, title) = sprintf("unset multiplot; height = %d.0; gap = 28; \
  set terminal pngcairo size 1200,%d font 'DejaVu Sans,11'; set output '%s.png'; \
  set xrange [0:run_max]; set autoscale y; set xtics auto; unset logscale; unset title; \
  set multiplot title \"%s\" font 'DejaVu Sans Bold,14' offset 0,-0.3", \
  pixels, pixels, name, title) . "; " . shade_phases . "; " . key_below
panel(left, right, top, bottom) = sprintf("set lmargin at screen %g; set rmargin at screen %g; \
  set tmargin at screen %g; set bmargin at screen %g", \
  left / 1200.0, 1 - right / 1200.0, 1 - top / height, bottom / height)

# Row `i` of `n` over the time of the whole run, with shaded phases. The first row has the names of
# the phases; names of short phases are one line higher, so that names do not overlap.
row_top(i, n, below) = 90 + (i - 1) * (height - 90 - below + gap) / n
row(i, n, right, below) = panel(95, right, row_top(i, n, below), \
  height - row_top(i + 1, n, below) + gap) . "; set xrange [0:run_max]; " . \
  (i == n ? "set xlabel 'time [s]'; set format x '%g'" : "unset xlabel; set format x ''") . "; " . \
  (i == 1 ? name_phases : "unset label")
name_phases = "do for [i = 1:phases] { \
  set label i phase_name[kind[i]] at first (start[i] + start[i+1]) / 2, graph 1 center \
    offset 0, (start[i+1] - start[i] < 0.035 * run_max ? 1.5 : 0.6) font ',9' textcolor rgb grey }"
shade_phases = "do for [i = 1:phases] { \
  set object i rectangle from first start[i], graph 0 to first start[i+1], graph 1 \
    behind fillstyle solid noborder fillcolor rgb phase_colour[kind[i]] }"
key_below = "set key on vertical maxrows 1 at screen 0.5, 24 / height center"

# ---- 3-D: the reference as a wide pale line, the flown trajectory as a thin line above it
eval picture("trajectory_3d", 800, "Flown trajectory of the centre of mass")
unset object
set view 62,32,1.75; set view equal xyz; set xyplane at 0; set border 127 + 256 + 512 lc rgb pale
set xrange [plan_min_x - 0.2 : plan_max_x + 0.2]; set yrange [plan_min_y - 0.2 : plan_max_y + 0.2]
set zrange [0:*]
set xlabel "x [m]" offset 0,-0.5; set ylabel "y [m]" offset 1,-0.5; set zlabel "z [m]" rotate
set xtics 0.5 offset 0,-0.3; set ytics 0.5 offset 0.3,-0.2; set ztics 0.5
splot $motion using (x("reference")):(y("reference")):(z("reference")) with lines \
        lc rgb "#CFCFCF" lw 7 title "reference", \
      "" using (only(!in(3) && !in(5), x("position"))):(y("position")):(z("position")) \
        with lines ls 2 lc rgb ink title "take-off, hover, landing", \
      "" using (only(in(3), x("position"))):(y("position")):(z("position")) \
        with lines ls 2 lc rgb blue title "in the air", \
      for [k = 1:driven] "" using (only(in(5), x("position"))):(y("position")):(z("position")) \
        with lines ls 2 lc rgb red title "on the ground"
set border 3 lc rgb grey; set xtics offset 0,0; set ytics auto offset 0,0
set xlabel offset 0,0.3; set ylabel offset 0,0

# ---- Tracking error
eval picture("tracking_error", 1000, "Tracking error: flown minus reference position, world frame")
eval row(1, 3, 30, 65)
set key horizontal inside bottom right maxrows auto
set ylabel "horizontal error [mm]"
plot for [a = 1:2] $motion using (t(0)):(error_mm(a)) with lines ls 1 lc rgb axis_colour[a] \
  title axis_name[a]
eval row(2, 3, 30, 65)
set ylabel "vertical error [mm]"
plot $motion using (t(0)):(error_mm(3)) with lines ls 1 lc rgb axis_colour[3] title axis_name[3]
eval row(3, 3, 30, 65)
set ylabel "distance to reference [mm]"; set logscale y; set yrange [0.1:*]
plot $motion using (t(0)):(distance_mm(0)) with lines ls 1 lc rgb ink notitle, \
     "" using (t(0)):(only(in(3), air_rmse)) with lines lw 3 lc rgb blue \
       title sprintf("RMSE in the air %.1f mm (paper: 52 mm)", air_rmse), \
     for [k = 1:driven] "" using (t(0)):(only(in(5), ground_rmse)) with lines lw 3 lc rgb red \
       title sprintf("RMSE on the ground %.1f mm (paper: 145 mm)", ground_rmse)

# ---- Force on a surface: each tick as a point, since a contact chatters where it slides
if (pushes) {
  eval picture("push_force", 900, "Pushing on a surface: force and place")
  eval row(1, 2, 30, 65)
  set key vertical inside top right maxrows auto
  set ylabel "force [N]"; set yrange [0:2.5 * push_max]
  plot $motion using (t(0)):(column("wall_force_n")) with points pt 7 ps 0.3 lc rgb blue notitle, \
       "" using (t(0)):(column("push_force_n")) with lines ls 2 lc rgb red title "reference", \
       NaN with points pt 7 lc rgb blue title "surface"
  eval row(2, 2, 30, 65)
  set key vertical inside top left maxrows auto
  set ylabel "position [m]"; set autoscale y
  plot $motion using (t(0)):(x("reference")) with lines lc rgb pale lw 5 title "reference", \
       "" using (t(0)):(y("reference")) with lines lc rgb pale lw 5 notitle, \
       "" using (t(0)):(x("position")) with lines ls 1 lc rgb blue title "x", \
       "" using (t(0)):(y("position")) with lines ls 1 lc rgb red title "y"
}

# ---- Height and contact: the whole run; below it, each change of the contact mode enlarged
eval picture("height_and_contact", 950, "Height of the centre of mass and contact with the ground")
eval row(1, 1, 30, changes ? 490 : 110)
set ylabel "height [m]"; set yrange [0:*]; set y2range [0:1]
flown(condition, scale) = only(condition, scale * z("position"))
plot $motion using (t(0)):(column("on_ground") * 0.05) axes x1y2 with fillsteps lc rgb sand \
       title "controller's contact mode", \
     "" using (t(0)):(z("reference")) with lines lc rgb pale lw 5 title "reference", \
     "" using (t(0)):(flown(!touching(0), 1)) with lines ls 2 lc rgb blue title "wheels free", \
     for [k = 1:driven] "" using (t(0)):(flown(touching(0), 1)) with lines ls 2 lc rgb red \
       title "wheels touch"
unset object; unset label; unset key; set xtics 0.5; set yrange [*:*<250]
do for [i = 1:(changes > 4 ? 4 : changes)] {
  eval panel(95 + (i - 1) * 281.7, 1105 - (i - 1) * 281.7 - 230, 555, 110)
  set xrange [change[i] - 0.5 : change[i] + 1]
  set title sprintf("mode changes at %.2f s", change[i]) offset 0,-0.6
  set ylabel (i == 1 ? "height [mm]" : "")
  plot $motion using (t(0)):(column("on_ground")) axes x1y2 with fillsteps lc rgb sand, \
       "" using (t(0)):(1e3 * z("reference")) with lines lc rgb pale lw 5, \
       "" using (t(0)):(flown(!touching(0), 1e3)) with lines ls 2 lc rgb blue, \
       "" using (t(0)):(flown(touching(0), 1e3)) with lines ls 2 lc rgb red
}

# ---- External wrench. The estimate is the low-pass filtered truth. The ranges fit the estimate and
# cut only contact impacts of the truth. The noisier curve is drawn first, below the other.
eval picture("external_wrench", 1300, "External force and torque in the body frame: true and \
estimated (which also holds the model's errors)")
is_true(layer, i) = (layer == 0) == (i <= 3)
source(layer, i) = is_true(layer, i) ? "external_" : "estimated_"
do for [i = 1:6] {
  a = (i - 1) % 3 + 1
  what = (i > 3 ? "torque_nm_" : "force_n_").axis_name[a]
  set xrange [0:run_max]; set autoscale y
  eval take("$wrench", "time_s|(estimated|external)_".what)
  stats $wrench using (column("estimated_".what)) name "span" nooutput
  set yrange [span_min - 0.15 * (span_max - span_min) : span_max + 0.15 * (span_max - span_min)]
  set ylabel sprintf(i > 3 ? "M_%s [N m]" : "F_%s [N]", axis_name[a])
  eval row(i, 6, 30, 100)
  plot for [layer = 0:1] $wrench using (t(0)):(column(source(layer, i).what)) with lines ls 1 \
    lc rgb (is_true(layer, i) ? ink : red) title (is_true(layer, i) ? "true" : "estimated")
  unset key
}

# ---- Tilt angles; beside each, the two seconds around its largest servo lag
eval picture("tilt_angles", 300 * rotors, \
  "Tilt angles of the arms, and the largest servo lags enlarged")
set key width 2; gap = 45
do for [r = 1:rotors] {
  set xrange [0:run_max]; set autoscale y; set xtics auto
  eval take("$arm", sprintf("time_s|tilt_.*_rad_%d", r))
  stats $arm using (t(0)):(abs(tilt_deg("command", r) - tilt_deg("true", r))) name "lag" nooutput
  if (lag_max_y == 0) { set yrange [-1:1] }  # the rotor does not tilt
  do for [zoom = 0:1] {
    eval row(r, rotors, zoom ? 30 : 385, 100)
    if (zoom) {
      set lmargin at screen 0.74; unset label; unset ylabel; set format x "%g"
      set xrange [lag_pos_max_y - 1 : lag_pos_max_y + 1]; set xtics 0.5
    } else { set ylabel sprintf("arm %d [deg]", r) }
    plot $arm using (t(0)):(tilt_deg("command", r)) with lines lw 3 lc rgb pale title "commanded", \
         "" using (t(0)):(tilt_deg("true", r)) with lines lw 2.5 lc rgb rotor_colour[r] \
           title "true", \
         "" using (t(0)):(tilt_deg("model", r)) with lines ls 1 dt 2 lc rgb ink title "modelled"
    unset key
  }
}

# ---- Rotor speeds
eval picture("rotor_speeds", 900, "Rotor speeds")
eval row(1, 2, 30, 90)
eval take("$speed", "time_s|rotor_speed_radps_.")
set ylabel "speed [rad/s]"; set yrange [0:*]
plot for [r = 1:rotors] $speed using (t(0)):(speed(r)) with lines ls 1 lc rgb rotor_colour[r] \
  title sprintf("rotor %d", r)
unset key
eval row(2, 2, 30, 90)
set ylabel "speed minus mean of all [rad/s]"; set autoscale y
plot for [r = 1:rotors] $speed using (t(0)):(speed(r) - mean_speed(0)) with lines ls 1 \
  lc rgb rotor_colour[r]

# ---- Power, and its means over the two figure eights, as in the paper; voltage of the battery
paper_air = 653.64; paper_ground = 47.38
eval picture("power", 800 + 300 * battery, driven ? sprintf("Electrical power: driving takes %.1f %% of what \
flying takes (paper: %.1f %%)", 100 * ground_mean_y / air_mean_y, 100 * paper_ground / paper_air) \
  : "Electrical power")
eval row(1, 1 + battery, 30, 65)
set key vertical at graph 0.66, graph 0.5 center maxrows auto
set ylabel "power [W]"; set yrange [0:*]
plot $motion using (t(0)):(power(0)) with lines ls 1 lc rgb ink title "power", \
     "" using (t(0)):(only(in(3), air_mean_y)) with lines lw 3.5 lc rgb blue \
       title sprintf("mean in the air: %.2f W", air_mean_y), \
     for [k = 1:driven] paper_air lc rgb blue lw 1.2 dt 2 \
       title sprintf("paper: %.2f W", paper_air), \
     for [k = 1:driven] $motion using (t(0)):(only(in(5), ground_mean_y)) with lines lw 3.5 lc rgb red \
       title sprintf("mean on the ground: %.2f W", ground_mean_y), \
     for [k = 1:driven] paper_ground lc rgb red lw 1.2 dt 2 \
       title sprintf("paper: %.2f W", paper_ground)
if (battery) {
  eval row(2, 2, 30, 65)
  unset key
  set ylabel "voltage under load [V]"; set autoscale y
  plot $motion using (t(0)):(column("voltage_v")) with lines ls 1 lc rgb purple notitle
}

# ---- Solve times: over time, and the fraction of ticks that take longer than a given time.
# Logarithmic axes show normal ticks and the few ticks that the operating system interrupted.
eval picture("solve_times", 1000, "Computing time of the controller per tick")
eval row(1, 1, 30, 510)
set ylabel "time [{/Symbol m}s]"; set yrange [1:20000]; set logscale y
plot times using (t(0)):(prepare(0)) with points pt 7 ps 0.3 lc rgb blue notitle, \
     "" using (t(0)):(feedback(0)) with points pt 7 ps 0.3 lc rgb red notitle, \
     NaN with points pt 7 lc rgb blue title sprintf( \
       "prepare, before the measurement: median %.1f {/Symbol m}s", solve_median_x), \
     NaN with points pt 7 lc rgb red title sprintf( \
       "feedback, measurement to command: median %.1f {/Symbol m}s", solve_median_y)
unset object; unset label; unset key
eval panel(95, 30, 570, 110)
# The fraction of larger values is the cumulative distribution of the negative values.
set xrange [0:-4.3]; set yrange [5e-5:1.2]; set xlabel "time [{/Symbol m}s]"
set xtics ("1" 0, "10" -1, "100" -2, "1000" -3, "10000" -4)
set ytics ("100" 1, "10" 0.1, "1" 0.01, "0.1" 0.001, "0.01" 0.0001)
set ylabel "ticks that take at least as long [%]"
plot times using (-log10(prepare(0))):(1) smooth cnorm with lines ls 2 lc rgb blue, \
     "" using (-log10(feedback(0))):(1) smooth cnorm with lines ls 2 lc rgb red
