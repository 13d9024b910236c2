#pragma once

#include "plant.hpp"

#include <tilt_ropter/planning/mission.hpp>

#include <EGL/egl.h>
#include <EGL/eglext.h>
#include <mujoco/mujoco.h>
#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <csignal>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <string>
#include <vector>

/// Film of the flight: MuJoCo renders without a screen, ffmpeg writes the files.
namespace examples {

/// An OpenGL context without a screen: the surfaceless platform of EGL, which Mesa provides in
/// software.
class OffscreenContext {
 public:
  /// Throws std::runtime_error if there is no such context.
  OffscreenContext() {
    // Looked up by name, because not every EGL exports it as a function.
    const auto get_display = reinterpret_cast<PFNEGLGETPLATFORMDISPLAYEXTPROC>(
        eglGetProcAddress("eglGetPlatformDisplayEXT"));
    if (get_display != nullptr)
      display_ = get_display(EGL_PLATFORM_SURFACELESS_MESA, nullptr, nullptr);
    if (display_ == EGL_NO_DISPLAY || eglInitialize(display_, nullptr, nullptr) == EGL_FALSE)
      throw std::runtime_error("no EGL display without a screen (Debian: libgl1-mesa-dri)");
    constexpr std::array<EGLint, 5> wanted = {EGL_SURFACE_TYPE, EGL_DONT_CARE, EGL_RENDERABLE_TYPE,
                                              EGL_OPENGL_BIT, EGL_NONE};
    EGLConfig config = nullptr;
    EGLint found = 0;
    if (eglBindAPI(EGL_OPENGL_API) == EGL_TRUE &&
        eglChooseConfig(display_, wanted.data(), &config, 1, &found) == EGL_TRUE && found > 0)
      context_ = eglCreateContext(display_, config, EGL_NO_CONTEXT, nullptr);
    if (context_ == EGL_NO_CONTEXT ||
        eglMakeCurrent(display_, EGL_NO_SURFACE, EGL_NO_SURFACE, context_) == EGL_FALSE) {
      eglTerminate(display_);
      throw std::runtime_error("no OpenGL context without a screen");
    }
  }
  OffscreenContext(const OffscreenContext&) = delete;
  OffscreenContext& operator=(const OffscreenContext&) = delete;
  ~OffscreenContext() {
    eglMakeCurrent(display_, EGL_NO_SURFACE, EGL_NO_SURFACE, EGL_NO_CONTEXT);
    eglDestroyContext(display_, context_);
    eglTerminate(display_);
  }

 private:
  EGLDisplay display_ = EGL_NO_DISPLAY;
  EGLContext context_ = EGL_NO_CONTEXT;
};

/// Writes mission.mp4 during the mission and a picture in each figure eight, air.png and
/// ground.png. finish() writes mission.gif.
template <int Rotors>
class Film {
 public:
  static constexpr int width = 960, height = 540;
  static constexpr double speed = 5.0;  ///< speed of the film relative to the simulated time
  static constexpr double frames_per_second = 10;  ///< frame rate of the film

  /// Throws std::runtime_error if rendering is impossible here or ffmpeg is missing.
  Film(const MujocoPlant<Rotors>& plant, const std::string& directory)
      : plant_(plant), directory_(directory), pixels_(3 * width * height) {
    if (std::system("ffmpeg -version > /dev/null 2>&1") != 0)
      throw std::runtime_error("ffmpeg is missing");
    // The end of ffmpeg is a write error and must not end this program.
    std::signal(SIGPIPE, SIG_IGN);
    mjv_defaultScene(&scene_);
    mjr_defaultContext(&renderer_);
    mjv_defaultOption(&options_);
    mjv_defaultCamera(&camera_);
    mjv_makeScene(&plant.model(), &scene_, 5000);
    mjr_makeContext(&plant.model(), &renderer_, mjFONTSCALE_150);
    mjr_setBuffer(mjFB_OFFSCREEN, &renderer_);
    options_.geomgroup[4] = 0;  // hides the geoms that touch the ground instead of the tyres
    file_ = popen(
        ("ffmpeg -v error -y -f rawvideo -pix_fmt rgb24 -s " + std::to_string(width) + 'x' +
         std::to_string(height) + " -r " + std::to_string(frames_per_second) +
         " -i - -vf vflip -c:v libx264 -crf 16 -pix_fmt yuv420p '" + path("mission.mp4") + '\'')
            .c_str(),
        "w");
    if (file_ == nullptr) throw std::runtime_error("cannot start ffmpeg");
    focus_ << 0.15, 0.0, 0.25;
  }
  Film(const Film&) = delete;
  Film& operator=(const Film&) = delete;
  ~Film() {
    if (file_ != nullptr) pclose(file_);
    mjr_freeContext(&renderer_);
    mjv_freeScene(&scene_);
  }

  /// Call this after every step: adds a frame when one is due.
  void on_step(const tilt_ropter::Mission& mission) {
    const double time = plant_.time();
    if (time >= next_mark_) {
      next_mark_ += 0.05;
      trail_.push_back(plant_.body().position);
    }
    if (time < next_frame_) return;
    next_frame_ += speed / frames_per_second;
    if (path_.empty()) sample(mission);
    // The camera moves only between air and ground: a moving camera makes the GIF much larger.
    const bool high = plant_.body().position.z() > 0.6;
    focus_.z() += 0.3 * ((high ? 1.25 : 0.25) - focus_.z());
    draw(4.6, 125.0, -22.0);
    if (std::fwrite(pixels_.data(), 1, pixels_.size(), file_) != pixels_.size())
      throw std::runtime_error("cannot write " + path("mission.mp4"));
    for (const auto& segment : mission.segments()) {
      const double instant =
          segment.start_time() + 0.28 * (segment.end_time() - segment.start_time());
      const bool now = time >= instant && time < instant + speed / frames_per_second;
      if (now && segment.phase == tilt_ropter::MissionPhase::air) picture("air.png", 1.5, 118, -14);
      if (now && segment.phase == tilt_ropter::MissionPhase::ground)
        picture("ground.png", 1.5, 118, -17);
    }
  }

  /// Ends the film and converts it to mission.gif.
  void finish() {
    const int closed = pclose(file_);
    file_ = nullptr;
    if (closed != 0) throw std::runtime_error("ffmpeg failed on " + path("mission.mp4"));
    const std::string convert =
        "ffmpeg -v error -y -i '" + path("mission.mp4") +
        "' -vf \"scale=480:-1:flags=area,split[a][b];[a]palettegen=max_colors=32:"
        "stats_mode=diff[p];[b][p]paletteuse=dither=none:diff_mode=rectangle\" '" +
        path("mission.gif") + '\'';
    if (std::system(convert.c_str()) != 0)
      throw std::runtime_error("ffmpeg failed on " + path("mission.gif"));
  }

 private:
  using Colour = std::array<float, 4>;

  /// Writes a picture of the current state, from `distance` [m], with view direction `azimuth`,
  /// `elevation` [deg].
  void picture(const std::string& name, double distance, double azimuth, double elevation) {
    const Eigen::Vector3d before = focus_;
    focus_ = plant_.body().position;
    draw(distance, azimuth, elevation);
    focus_ = before;
    FILE* out = popen(("ffmpeg -v error -y -f rawvideo -pix_fmt rgb24 -s " + std::to_string(width) +
                       'x' + std::to_string(height) + " -i - -vf vflip '" + path(name) + '\'')
                          .c_str(),
                      "w");
    if (out == nullptr) throw std::runtime_error("cannot start ffmpeg");
    const bool written = std::fwrite(pixels_.data(), 1, pixels_.size(), out) == pixels_.size();
    if (pclose(out) != 0 || !written) throw std::runtime_error("cannot write " + path(name));
  }

  [[nodiscard]] std::string path(const std::string& name) const { return directory_ + '/' + name; }

  void sample(const tilt_ropter::Mission& mission) {
    for (const auto& segment : mission.segments()) {
      if (segment.phase != tilt_ropter::MissionPhase::air &&
          segment.phase != tilt_ropter::MissionPhase::ground)
        continue;
      std::vector<Eigen::Vector3d> eight;
      for (double t = segment.start_time(); t < segment.end_time(); t += 0.1)
        if (eight.empty() || (segment(t).position - eight.back()).norm() > 0.06)
          eight.push_back(segment(t).position);
      if (segment.phase == tilt_ropter::MissionPhase::ground)
        for (Eigen::Vector3d& point : eight) point.z() = 0.004;
      path_.push_back(std::move(eight));
    }
  }

  void connect(int type, double thickness, const Eigen::Vector3d& from, const Eigen::Vector3d& to,
               const Colour& colour) {
    if (scene_.ngeom >= scene_.maxgeom) return;
    mjvGeom& geom = scene_.geoms[scene_.ngeom++];
    mjv_initGeom(&geom, type, nullptr, nullptr, nullptr, colour.data());
    geom.category = mjCAT_DECOR;  // no shadow
    mjv_makeConnector(&geom, type, thickness, from.x(), from.y(), from.z(), to.x(), to.y(), to.z());
  }

  void draw(double distance, double azimuth, double elevation) {
    camera_.distance = distance;
    camera_.azimuth = azimuth;
    camera_.elevation = elevation;
    for (int i = 0; i < 3; ++i) camera_.lookat[i] = focus_(i);
    mjv_updateScene(&plant_.model(), &plant_.data(), &options_, nullptr, &camera_, mjCAT_ALL,
                    &scene_);
    constexpr Colour reference{0.45f, 0.48f, 0.53f, 1.0f}, flown{0.10f, 0.45f, 0.85f, 1.0f},
        thrust{0.10f, 0.65f, 0.30f, 1.0f};
    for (const auto& eight : path_)
      for (std::size_t i = 1; i < eight.size(); ++i)
        connect(mjGEOM_CAPSULE, 0.004, eight[i - 1], eight[i], reference);
    const std::size_t oldest = trail_.size() > 60 ? trail_.size() - 60 : 0;
    for (std::size_t i = oldest + 1; i < trail_.size(); ++i)
      connect(mjGEOM_CAPSULE, 0.008, trail_[i - 1], trail_[i], flown);
    for (int i = 0; i < Rotors; ++i) {
      const int site =
          mj_name2id(&plant_.model(), mjOBJ_SITE, ("rotor" + std::to_string(i + 1)).c_str());
      const Eigen::Map<const Eigen::Vector3d> at(plant_.data().site_xpos + 3 * site);
      const mjtNum* axes = plant_.data().site_xmat + 9 * site;
      const Eigen::Vector3d up(axes[2], axes[5], axes[8]);
      const double force = plant_.thrust(static_cast<std::size_t>(i));
      if (force > 0.02)
        connect(mjGEOM_ARROW, 0.011, at + 0.04 * up, at + (0.05 + 0.055 * force) * up, thrust);
    }
    const mjrRect all{0, 0, width, height};
    mjr_render(all, &scene_, &renderer_);
    mjr_readPixels(pixels_.data(), nullptr, all, &renderer_);
  }

  const MujocoPlant<Rotors>& plant_;
  std::string directory_;
  OffscreenContext context_;
  std::vector<unsigned char> pixels_;
  mjvScene scene_;
  mjrContext renderer_;
  mjvOption options_;
  mjvCamera camera_;
  FILE* file_ = nullptr;
  /// Times of the next frame and the next point of the trail [s].
  double next_frame_ = 0.0, next_mark_ = 0.0;
  std::vector<std::vector<Eigen::Vector3d>> path_;  ///< reference: the figure eights
  std::vector<Eigen::Vector3d> trail_;              ///< flown path
  Eigen::Vector3d focus_ = Eigen::Vector3d::Zero();
};

}  // namespace examples
