#pragma once

#include <Eigen/Core>

#include <cmath>
#include <iomanip>
#include <sstream>
#include <string>
#include <vector>

/// Drawings as SVG files.
namespace examples::paper {

/// Colour and width of a line, and the colour of an area.
struct Style {
  std::string stroke = "#222222", fill = "none";
  double width = 1.5;
  std::string dashes = {};  ///< such as "5 4"
  double opacity = 1.0;
};

/// A drawing in pixels: x to the right, y down.
class Svg {
 public:
  using Point = Eigen::Vector2d;

  Svg(int width, int height, const std::string& title) {
    out_ << std::fixed << std::setprecision(1);
    out_ << "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"" << width << "\" height=\""
         << height << "\" viewBox=\"0 0 " << width << ' ' << height
         << "\" font-family=\"DejaVu Sans, Arial, sans-serif\">\n<title>" << title
         << "</title>\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n";
  }

  void polyline(const std::vector<Point>& points, const Style& style, bool closed = false) {
    out_ << (closed ? "<polygon" : "<polyline") << " points=\"";
    for (std::size_t i = 0; i < points.size(); ++i)
      out_ << (i > 0 ? " " : "") << points[i].x() << ',' << points[i].y();
    out_ << '"';
    put(style);
    out_ << " stroke-linejoin=\"round\"/>\n";
  }

  /// A line along `points` with a head at its last point.
  void arrow(std::vector<Point> points, const Style& style, double head = 9.0) {
    const Point tip = points.back();
    Point along = tip - points[points.size() - 2];
    if (along.norm() > 1e-6) along.normalize();
    const Point across(-along.y(), along.x()), back = tip - head * along;
    points.back() = back;
    polyline(points, style);
    Style solid = style;
    solid.fill = style.stroke;
    solid.dashes.clear();
    solid.width = 0.5;
    polyline({tip, back + 0.38 * head * across, back - 0.38 * head * across}, solid, true);
  }

  void rectangle(const Point& corner, const Point& size, const Style& style, double radius = 6.0) {
    out_ << "<rect x=\"" << corner.x() << "\" y=\"" << corner.y() << "\" width=\"" << size.x()
         << "\" height=\"" << size.y() << "\" rx=\"" << radius << '"';
    put(style);
    out_ << "/>\n";
  }

  /// `anchor`: start, middle or end. `_` before a letter makes it a subscript: "p_r".
  void text(const Point& at, const std::string& words, double size = 14.0,
            const std::string& anchor = "middle", const std::string& colour = "#222222",
            const std::string& more = {}) {
    out_ << "<text x=\"" << at.x() << "\" y=\"" << at.y() << "\" font-size=\"" << size
         << "\" text-anchor=\"" << anchor << "\" fill=\"" << colour << "\" " << more << '>';
    for (std::size_t i = 0; i < words.size(); ++i) {
      if (words[i] != '_') {
        out_ << words[i];
        continue;
      }
      std::string low;
      while (i + 1 < words.size() && std::isalnum(static_cast<unsigned char>(words[i + 1])) != 0)
        low += words[++i];
      out_ << "<tspan dy=\"" << 0.3 * size << "\" font-size=\"" << 0.72 * size << "\">" << low
           << "</tspan><tspan dy=\"" << -0.3 * size << "\">&#8203;</tspan>";
    }
    out_ << "</text>\n";
  }

  [[nodiscard]] std::string str() const { return out_.str() + "</svg>\n"; }

 private:
  void put(const Style& s) {
    out_ << " fill=\"" << s.fill << "\" stroke=\"" << s.stroke << "\" stroke-width=\"" << s.width
         << '"';
    if (!s.dashes.empty()) out_ << " stroke-dasharray=\"" << s.dashes << '"';
    if (s.opacity < 1.0) out_ << " opacity=\"" << std::setprecision(2) << s.opacity << '"';
    out_ << std::setprecision(1);
  }

  std::ostringstream out_;
};

}  // namespace examples::paper
