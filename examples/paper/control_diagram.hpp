#pragma once

#include "svg.hpp"

#include <string>
#include <vector>

/// The control architecture as a drawing (paper, Sec. Control, Fig. control_diagram), with what the
/// library adds.
namespace examples::paper {

namespace detail {

/// A block of the diagram: its corner and its size in pixels, its lines of text.
struct Block {
  double x, y, width, height;
  std::vector<std::string> lines;
  bool added = false;  ///< not in the paper

  [[nodiscard]] Svg::Point left(double part = 0.5) const { return {x, y + part * height}; }
  [[nodiscard]] Svg::Point right(double part = 0.5) const { return {x + width, y + part * height}; }
  [[nodiscard]] Svg::Point top(double part = 0.5) const { return {x + part * width, y}; }
  [[nodiscard]] Svg::Point bottom(double part = 0.5) const {
    return {x + part * width, y + height};
  }
};

inline void draw(Svg& svg, const Block& b) {
  Style style;
  style.stroke = b.added ? "#B35900" : "#0072B2";
  style.fill = b.added ? "#FDF1E3" : "#EAF3FA";
  svg.rectangle({b.x, b.y}, {b.width, b.height}, style);
  const double first = b.y + 0.5 * b.height - 9.0 * static_cast<double>(b.lines.size()) + 14.0;
  for (std::size_t i = 0; i < b.lines.size(); ++i)
    svg.text({b.x + 0.5 * b.width, first + 18.0 * static_cast<double>(i)}, b.lines[i],
             i == 0 ? 14.0 : 11.5, "middle", "#222222", i == 0 ? "font-weight=\"bold\"" : "");
}

}  // namespace detail

[[nodiscard]] inline std::string draw_control_diagram() {
  using detail::Block;
  using Point = Svg::Point;
  Svg svg(1240, 600, "Control architecture");
  const Block planner{30, 60, 150, 84, {"Motion planner", "references, missions"}},
      nmpc{290, 60, 170, 84, {"NMPC", "wrench and its rate", "at 100 Hz"}},
      allocation{590, 60, 160, 84, {"Control allocation", "limits, lead of lags"}},
      motors{880, 60, 140, 84, {"Motors, servos"}},
      vehicle{1090, 60, 130, 84, {"Vehicle", "body, wheels,", "ground"}},
      contact{290, 260, 170, 84, {"Contact estimate", "on ground?, plane,", "who gives the wrench"},
              true},
      observer{570, 260, 150, 84, {"Wrench observer", "gains K_f, K_m"}},
      model{840, 260, 180, 84, {"Actuator model", "first-order servos,", "allocation matrix A"}},
      ekf{430, 460, 250, 84, {"EKF", "position, velocity, attitude, rates,", "biases of the IMU"}},
      imu{1040, 420, 140, 48, {"IMU"}}, capture{1040, 500, 140, 48, {"Motion capture"}};

  const Style line;
  Style ours;
  ours.stroke = "#B35900";
  const auto arrow = [&](const std::vector<Point>& points, bool added = false) {
    svg.arrow(points, added ? ours : line);
  };
  const auto label = [&](double x, double y, const std::string& words,
                         const std::string& anchor = "middle") {
    svg.text({x, y}, words, 13.0, anchor, "#222222", "font-style=\"italic\"");
  };

  arrow({planner.right(), nmpc.left()});
  label(235, 78, "p_r, v_r,");
  label(235, 95, "q_r, &#969;_r");
  arrow({nmpc.right(), allocation.left()});
  label(525, 78, "F, M");
  label(525, 95, "rates of both");
  arrow({allocation.right(), motors.left()});
  label(815, 95, "&#937;_i, &#945;_i");
  arrow({motors.right(), vehicle.left()});
  label(1055, 95, "T_i");

  arrow({allocation.bottom(), {allocation.bottom().x(), 200}, {900, 200}, {900, model.y}});
  label(785, 193, "commanded &#945;_i");
  arrow({motors.bottom(0.75), {motors.bottom(0.75).x(), model.y}});
  label(992, 235, "measured &#937;_m", "start");
  arrow({model.left(), observer.right()});
  label(780, 293, "applied F, M");
  arrow({observer.left(), contact.right()});
  label(515, 293, "F&#770;_e, M&#770;_e");
  arrow({contact.top(), nmpc.bottom()}, true);
  label(384, 185, "&#948;, ground plane,", "start");
  label(384, 203, "external wrench", "start");
  arrow({vehicle.bottom(0.4), {vehicle.bottom(0.4).x(), imu.y}});
  arrow({vehicle.bottom(0.9), {vehicle.bottom(0.9).x(), capture.right().y()}, capture.right()});
  arrow({imu.left(), {760, imu.left().y()}, {760, 485}, {ekf.right().x(), 485}});
  label(900, 437, "a, &#969;");
  arrow({capture.left(), {ekf.right().x(), 524}});
  label(900, 517, "p_m, q_m");
  arrow({{640, ekf.y}, {640, observer.y + observer.height}});
  label(648, 405, "a, &#969; without biases", "start");
  arrow({{445, ekf.y}, {445, contact.y + contact.height}}, true);
  label(453, 425, "p&#770;, v&#770;, q&#770;, &#969;&#770;", "start");
  arrow({ekf.left(), {90, ekf.left().y()}, {90, 190}, {262, 190}, {262, 122}, nmpc.left(0.74)});
  label(250, 492, "state estimate p&#770;, v&#770;, q&#770;, &#969;&#770;");

  for (const Block& b :
       {planner, nmpc, allocation, motors, vehicle, contact, observer, model, ekf, imu, capture})
    detail::draw(svg, b);
  Style blue, orange;
  blue.stroke = "#0072B2";
  blue.fill = "#EAF3FA";
  orange.stroke = "#B35900";
  orange.fill = "#FDF1E3";
  svg.rectangle({30, 562}, {22, 16}, blue, 3.0);
  svg.text({60, 575}, "as in the paper", 12.0, "start");
  svg.rectangle({180, 562}, {22, 16}, orange, 3.0);
  svg.text({210, 575}, "added by the library", 12.0, "start");
  return svg.str();
}

}  // namespace examples::paper
