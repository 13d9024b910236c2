#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>

/// Writes logs as PX4 does, from the format's specification (docs.px4.io, "ULog File Format"). It
/// shares no code with the reader.
namespace test_support {

/// Numbers one after the other, little-endian, as in a message.
class Packed {
 public:
  template <typename Number>
  Packed& add(Number value) {
    char bytes[sizeof value];
    std::memcpy(bytes, &value, sizeof value);
    text_.append(bytes, sizeof value);
    return *this;
  }
  /// As float.
  template <typename Vector>
  Packed& add_floats(const Vector& values) {
    for (int i = 0; i < values.size(); ++i) add(static_cast<float>(values(i)));
    return *this;
  }
  Packed& add(const std::string& text) {
    text_ += text;
    return *this;
  }
  Packed& add(const char* text) { return add(std::string(text)); }
  [[nodiscard]] const std::string& bytes() const { return text_; }

 private:
  std::string text_;
};

class UlogWriter {
 public:
  UlogWriter() {
    bytes_ = Packed().add(std::string("ULog\x01\x12\x35\x01", 8)).add(std::uint64_t{0}).bytes();
    message('B', std::string(40, '\0'));
  }

  void message(char type, const std::string& content) {
    bytes_ +=
        Packed().add(static_cast<std::uint16_t>(content.size())).add(type).add(content).bytes();
  }
  /// Such as "NAME:uint64_t timestamp;float[3] x;".
  void format(const std::string& text) { message('F', text); }
  /// Returns the id of the messages.
  std::uint16_t subscribe(const std::string& name, int instance = 0) {
    message('A', Packed().add(static_cast<std::uint8_t>(instance)).add(next_).add(name).bytes());
    return next_++;
  }
  void data(std::uint16_t id, const Packed& content) {
    message('D', Packed().add(id).add(content.bytes()).bytes());
  }
  /// Ends within a message; what follows was appended later.
  void cut_off_and_append() {
    bytes_ += std::string("\x30\0D\0\0", 5);
    bytes_[16 + 3 + 8] = 1;
    const std::string offset = Packed().add(std::uint64_t{bytes_.size()}).bytes();
    bytes_.replace(16 + 3 + 16, 8, offset);
  }

  [[nodiscard]] const std::string& bytes() const { return bytes_; }

 private:
  std::string bytes_;
  std::uint16_t next_ = 0;
};

/// The formats of the topics that the programs read, as in PX4 1.15.
inline constexpr const char* px4_formats[] = {
    "sensor_combined:uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;"
    "uint32_t accelerometer_integral_dt;uint8_t accelerometer_clipping;uint8_t gyro_clipping;"
    "uint8_t accel_calibration_count;uint8_t gyro_calibration_count;",
    "vehicle_odometry:uint64_t timestamp;uint64_t timestamp_sample;float[3] position;float[4] q;"
    "float[3] velocity;float[3] angular_velocity;float[3] position_variance;"
    "float[3] orientation_variance;float[3] velocity_variance;uint8_t pose_frame;"
    "uint8_t velocity_frame;uint8_t reset_counter;int8_t quality;uint8_t[4] _padding0;",
    "actuator_motors:uint64_t timestamp;uint64_t timestamp_sample;float[12] control;"
    "uint16_t reversible_flags;uint8_t[6] _padding0;",
    "actuator_servos:uint64_t timestamp;uint64_t timestamp_sample;float[8] control;",
    "esc_report:uint64_t timestamp;uint32_t esc_errorcount;int32_t esc_rpm;float esc_voltage;"
    "float esc_current;float esc_temperature;uint16_t failures;uint8_t esc_address;"
    "uint8_t esc_cmdcount;uint8_t esc_state;uint8_t actuator_function;int8_t esc_power;"
    "uint8_t[5] _padding0;",
    "esc_status:uint64_t timestamp;uint16_t counter;uint8_t esc_count;uint8_t esc_connectiontype;"
    "uint8_t esc_online_flags;uint8_t esc_armed_flags;uint8_t[2] _padding0;esc_report[8] esc;"};

[[nodiscard]] inline std::uint64_t microseconds(double time) {
  return static_cast<std::uint64_t>(std::llround(1e6 * time));
}

/// `gyro` and `accelerometer`: forward-left-up.
template <typename Vector>
Packed sensor_combined(double time, const Vector& gyro, const Vector& accelerometer) {
  Packed m;
  m.add(microseconds(time));
  for (const Vector* v : {&gyro, &accelerometer}) {
    m.add(static_cast<float>((*v)(0)));
    m.add(static_cast<float>(-(*v)(1))).add(static_cast<float>(-(*v)(2)));
    m.add(std::uint32_t{5000});
    if (v == &gyro) m.add(std::int32_t{0});
  }
  return m.add(std::uint32_t{0});
}

/// ENU and forward-left-up; the velocity in the world. Without the padding at its end.
template <typename Vector, typename Quaternion>
Packed vehicle_odometry(double time, const Vector& position, const Quaternion& q,
                        const Vector& velocity) {
  // The world turns by 180 degrees about (1, 1, 0), the body about x.
  const double half = 0.70710678118654752440;
  const Quaternion ned = Quaternion(0.0, half, half, 0.0) * q * Quaternion(0.0, 1.0, 0.0, 0.0);
  const auto turned = [](Packed& m, const Vector& v) {
    m.add(static_cast<float>(v(1))).add(static_cast<float>(v(0))).add(static_cast<float>(-v(2)));
  };
  Packed m;
  m.add(microseconds(time) + 3000).add(microseconds(time));
  turned(m, position);
  for (const double part : {ned.w(), ned.x(), ned.y(), ned.z()}) m.add(static_cast<float>(part));
  turned(m, velocity);
  for (int i = 0; i < 12; ++i) m.add(0.0F);
  return m.add(std::uint8_t{1}).add(std::uint8_t{1}).add(std::uint8_t{0}).add(std::int8_t{100});
}

}  // namespace test_support
