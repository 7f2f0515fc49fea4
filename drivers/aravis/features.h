#pragma once

#include <arv.h>

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// A camera's GenICam features: what is set is checked against the camera's range first and read back afterwards.
/// Messages name the camera and the setting that an operator knows ("exposure_us"). Not thread-safe, as GenICam trees
/// are not.
///
/// Errors of every set function: invalid_argument  the camera cannot take the value, or took another one; unsupported
/// it has no such feature; device_lost  it does not answer.
class Features {
 public:
  Features(ArvCamera* camera, std::string id) : camera_(camera), id_(std::move(id)) {}

  /// Implemented and available now.
  bool has(const char* feature) const;
  std::vector<std::string> entries(const char* feature) const;

  Result<void> set_float(const char* feature, double value, const std::string& setting) const;
  Result<void> set_integer(const char* feature, int64_t value, const std::string& setting) const;
  /// Of a feature that cannot be read back.
  Result<void> write_integer(const char* feature, int64_t value, const std::string& setting) const;
  Result<void> set_entry(const char* feature, const std::string& entry, const std::string& setting) const;
  Result<void> set_boolean(const char* feature, bool value, const std::string& setting) const;
  /// A feature of any kind from text; commands are executed.
  Result<void> set_from_text(const std::string& feature, const std::string& value) const;
  /// As set_entry and set_boolean where the camera has the feature; otherwise nothing happens.
  Result<void> set_entry_if_any(const char* feature, const std::string& entry, const std::string& setting) const;

  Result<double> get_float(const char* feature) const;
  Result<int64_t> get_integer(const char* feature) const;
  Result<std::string> get_text(const char* feature) const;
  Result<void> execute(const char* command) const;

  /// "camera ID: SETTING: WHAT".
  Error refuse(const std::string& setting, const std::string& what) const;
  /// The camera did not answer, or refused for reasons of its own.
  Error failed(const std::string& what, const class GErrorSlot& error) const;

 private:
  Result<void> check_read_back(double got, double wanted, double tolerance, const std::string& setting) const;

  ArvCamera* camera_;
  std::string id_;
};

/// A number for people: 20000 instead of 2e+04, at most six digits.
std::string number_text(double value);

}  // namespace booth
