# Draws the paper's figures from the results of reproduce_paper. Reads the logs in the current
# directory, as far as they are there, and writes the pictures there. Reads columns by name.

set datafile separator ","
set datafile columnheaders

# ---- Style: the palette of Okabe and Ito, as in hybrid_mission.gp
blue = "#0072B2"; red = "#D55E00"; green = "#009E73"; purple = "#CC79A7"
ink = "#222222"; grey = "#666666"; pale = "#C8C8C8"
set border 3 lc rgb grey
set tics nomirror out scale 0.6 textcolor rgb ink
set grid back lt 1 lc rgb "#DDDDDD" lw 0.5
set key samplen 2 reverse Left textcolor rgb ink

# ---- Flights: settings and plants with their names and colours
array settings[4] = ["library", "library", "preset", "preset_wider_bounds"]
array plants[4] = ["plant", "mujoco", "plant", "plant"]
array names[4] = ["library, our plant", "library, MuJoCo", "paper as printed, our plant", \
                  "paper with wider bounds, our plant"]
array colours[4] = [blue, green, red, purple]
log_of(experiment, i) = experiment."_".settings[i]."_".plants[i]."/hybrid_mission.csv"
is_there(file) = system("test -s ".file." && echo 1 || echo 0") + 0
flown(experiment, i) = is_there(log_of(experiment, i))
flights(experiment) = (flown(experiment, 1) ? "1 " : "") . (flown(experiment, 2) ? "2 " : "") . \
  (flown(experiment, 3) ? "3 " : "") . (flown(experiment, 4) ? "4" : "")
air = flights("air"); ground = flights("ground"); hybrid = flights("hybrid")

# ---- Columns. gnuplot functions need an argument: (_) marks an unused one
t(_) = column("time_s")
moves(_) = column("phase") == 1 || column("phase") >= 3
x(of) = column(of."_m_x"); y(of) = column(of."_m_y"); z(of) = column(of."_m_z")
error_mm(_) = 1e3 * sqrt((x("position") - x("reference"))**2 + (y("position") - y("reference"))**2 \
  + (z("position") - z("reference"))**2)

# A flight that leaves the reference by metres would hide the others: its curve ends there.
near(value) = error_mm(0) < 1500 ? value : NaN

# ---- Pictures. Every picture resets what the pictures before it have set.
picture(file, width, height) = sprintf("set terminal pngcairo size %d,%d font 'DejaVu Sans,11'; \
  set output '%s'; set border 3 lc rgb grey; set size noratio; set xtics auto; set ytics auto; \
  set autoscale; unset logscale; unset title; set key default; \
  set key samplen 2 reverse Left textcolor rgb ink", width, height, file)
space = "set view 60,30,1.2; set view equal xyz; set xyplane at 0; \
  set border 127 + 256 + 512 lc rgb pale; set xlabel 'x [m]'; set ylabel 'y [m]'; \
  set zlabel 'z [m]'; set xtics 1; set ytics 1; set ztics 0.5"

# ---- Trajectories in the air and on the ground (paper, Fig. exp_air_or_gnd)
if (strlen(air) && strlen(ground)) {
  eval picture("paper_trajectories.png", 1200, 560)
  set multiplot layout 1,2 title "Figure eights: reference and flown" font "DejaVu Sans Bold,14"
  eval space
  set xyplane at 0.9; set view 62,35,1.75; set title "(a) in the air"
  set key at screen 0.5, 0.08 center horizontal maxrows 2
  splot log_of("air", word(air, 1) + 0) using (x("reference")):(y("reference")):(z("reference")) \
          with lines lc rgb pale lw 7 title "reference", \
        for [i in air] log_of("air", i + 0) using (near(x("position"))):(y("position")):(z("position")) \
          with lines lc rgb colours[i + 0] lw 1.5 title names[i + 0]
  set title "(b) on the ground"; set border 3 lc rgb grey; unset key
  set size ratio -1; set xtics 1; set ytics 0.5; set bmargin 6
  set xrange [-2.3:2.3]; set yrange [-1.2:1.2]
  plot log_of("ground", word(ground, 1) + 0) using (x("reference")):(y("reference")) \
         with lines lc rgb pale lw 7 title "reference", \
       for [i in ground] log_of("ground", i + 0) using (near(x("position"))):(y("position")) \
         with lines lc rgb colours[i + 0] lw 1.5 title names[i + 0]
  unset multiplot; unset bmargin
}

# ---- The hybrid trajectory (paper, Fig. exp_air_gnd)
if (strlen(hybrid)) {
  eval picture("paper_hybrid.png", 1200, 600)
  eval space
  set view 58,20,2.2; set title "Hybrid trajectory: from the air to the ground and back without a stop" \
    font "DejaVu Sans Bold,14"
  set key at screen 0.5, 0.09 center horizontal maxrows 2
  splot log_of("hybrid", word(hybrid, 1) + 0) \
          using (x("reference")):(y("reference")):(z("reference")) \
          with lines lc rgb pale lw 7 title "reference", \
        for [i in hybrid] log_of("hybrid", i + 0) \
          using (near(x("position"))):(y("position")):(z("position")) \
          with lines lc rgb colours[i + 0] lw 1.5 title names[i + 0]
  unset title
}

# ---- Tracking error over time
if (strlen(air) || strlen(ground) || strlen(hybrid)) {
  eval picture("paper_tracking.png", 1200, 900)
  set multiplot layout 3,1 margins 0.07,0.98,0.13,0.91 spacing 0.09 title "Distance to the reference" font "DejaVu Sans Bold,14"
  set ylabel "distance [mm]" offset 1.2,0; set logscale y; set yrange [0.1:1e4]; set xlabel "time [s]" offset 0,0.6
  array paper_mm[3] = [52, 145, 125]
  array experiments[3] = ["air", "ground", "hybrid"]
  do for [e = 1:3] {
    list = e == 1 ? air : e == 2 ? ground : hybrid
    if (strlen(list)) {
      set title experiments[e] offset 0,-0.8
      if (e == 1) { set key at screen 0.5, 0.03 center horizontal maxrows 2 } else { unset key }
      plot for [i in list] log_of(experiments[e], i + 0) using (t(0)):(error_mm(0)) with lines \
             lc rgb colours[i + 0] lw 1.5 title names[i + 0], \
           paper_mm[e] lc rgb ink dt 2 title "paper, RMSE"
    }
  }
  unset multiplot; set xlabel offset 0,0; set ylabel offset 0,0
}

# ---- Power over time (paper, Fig. power)
if (strlen(hybrid)) {
  i = word(hybrid, 1) + 0
  stats log_of("hybrid", i) using (column("phase") == 3 ? column("power_w") : NaN) name "air" nooutput
  stats log_of("hybrid", i) using (column("phase") == 5 ? column("power_w") : NaN) name "ground" \
    nooutput
  eval picture("paper_power.png", 1200, 480)
  set title sprintf("Power along the hybrid trajectory (%s)", names[i]) font "DejaVu Sans Bold,14"
  set xlabel "time [s]"; set ylabel "power [W]"; set yrange [0:*]
  set key at graph 0.99, graph 0.55 right
  plot log_of("hybrid", i) using (t(0)):(column("power_w")) with lines lc rgb ink lw 1.5 \
         title "power", \
       "" using (t(0)):(column("phase") == 3 ? air_mean : NaN) with lines lc rgb blue lw 4 \
         title sprintf("mean in the air: %.1f W", air_mean), \
       653.64 lc rgb blue dt 2 title "paper: 653.64 W", \
       log_of("hybrid", i) using (t(0)):(column("phase") == 5 ? ground_mean : NaN) with lines \
         lc rgb red lw 4 title sprintf("mean on the ground: %.1f W", ground_mean), \
       47.38 lc rgb red dt 2 title "paper: 47.38 W"
  unset title
}

# ---- Identification of the servo (paper, Fig. servo_id)
if (is_there("servo_identification.csv")) {
  eval picture("paper_servo.png", 1200, 480)
  set title "Servo: pulse width, measured and fitted angle" font "DejaVu Sans Bold,14"
  set xlabel "time [s]"; set ylabel "angle [deg]"; set y2label "pulse width [{/Symbol m}s]"
  set border 11 lc rgb grey; set y2tics; set autoscale; set xrange [0:3]
  degrees(name) = column(name) * 180 / pi
  set yrange [-30:30]; set y2range [1500 - 30 * 1000 / 180.0 : 1500 + 30 * 1000 / 180.0]
  plot "servo_identification.csv" using (t(0)):(column("pwm_us")) axes x1y2 with steps \
         lc rgb green lw 2 title "PWM to the servo", \
       "" using (t(0)):(degrees("angle_rad")) with points pt 7 ps 0.4 lc rgb blue \
         title "encoder", \
       "" using (t(0)):(degrees("fit_rad")) with lines lc rgb red lw 2 title "fitted first order"
}
