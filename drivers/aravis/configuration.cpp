#include "drivers/aravis/configuration.h"

#include <algorithm>
#include <array>
#include <map>

namespace booth {
namespace {

/// The first of these features that the camera has; the last where it has none, for the message.
template <size_t count>
const char* first_of(const Features& features, const std::array<const char*, count>& names) {
  const auto found = std::find_if(names.begin(), names.end(), [&](const char* name) { return features.has(name); });
  return found == names.end() ? names.back() : *found;
}

const char* gain_feature(const Features& features) { return first_of(features, std::array{"GainAbs", "Gain"}); }

Result<void> apply_device(const Features& features, const AravisCameraSettings& settings) {
  if (features.has("GevHeartbeatTimeout"))
    if (const auto set = features.set_integer("GevHeartbeatTimeout", settings.heartbeat_ms, "heartbeat_ms"); !set)
      return set;
  const char* ptp = first_of(features, std::array{"GevIEEE1588", "PtpEnable"});
  if (settings.ptp && !features.has(ptp))
    return Error{ErrorCode::unsupported, features.refuse("ptp", "the camera does not offer it").message};
  if (features.has(ptp))
    if (const auto set = features.set_boolean(ptp, settings.ptp, "ptp"); !set) return set;
  return {};
}

/// A camera that delivers colours as asked, from the wanted part of its sensor.
Result<AravisPicture> apply_image_format(const Features& features, const AravisCameraSettings& settings) {
  static const std::map<std::string, std::optional<BayerPattern>> formats{
      {"Mono8", std::nullopt},          {"RGB8", std::nullopt},           {"BayerRG8", BayerPattern::rggb},
      {"BayerGR8", BayerPattern::grbg}, {"BayerGB8", BayerPattern::gbrg}, {"BayerBG8", BayerPattern::bggr}};
  // Older cameras call it RGB8Packed.
  std::string format = settings.pixel_format;
  const auto offered = features.entries("PixelFormat");
  const auto offers = [&](const std::string& name) {
    return std::find(offered.begin(), offered.end(), name) != offered.end();
  };
  if (format == "RGB8" && !offers(format) && offers("RGB8Packed")) format = "RGB8Packed";
  if (const auto set = features.set_entry("PixelFormat", format, "pixel_format"); !set) return set.error();
  if (features.has("ChunkModeActive"))
    if (const auto set = features.set_boolean("ChunkModeActive", false, "chunk data"); !set) return set.error();

  // Offsets first to nothing, or the size that is wanted may not fit.
  const AravisRegion& region = settings.region;
  for (const char* offset : {"OffsetX", "OffsetY"})
    if (features.has(offset))
      if (const auto set = features.set_integer(offset, 0, "region"); !set) return set.error();
  const auto side = [&](const char* size_feature, const char* offset_feature, int size, int offset,
                        const std::string& name) -> Result<int64_t> {
    if (size == 0) {
      const char* sensor = name == "width" ? "WidthMax" : "HeightMax";
      if (!features.has(sensor)) sensor = name == "width" ? "SensorWidth" : "SensorHeight";
      const auto whole = features.get_integer(sensor);
      if (!whole) return whole.error();
      size = static_cast<int>(*whole) - offset;
    }
    if (const auto set = features.set_integer(size_feature, size, "region." + name); !set) return set.error();
    const std::string axis = name == "width" ? "region.x" : "region.y";
    if (offset != 0)
      if (const auto set = features.set_integer(offset_feature, offset, axis); !set) return set.error();
    return int64_t{size};
  };
  const auto width = side("Width", "OffsetX", region.width, region.x, "width");
  if (!width) return width.error();
  const auto height = side("Height", "OffsetY", region.height, region.y, "height");
  if (!height) return height.error();

  // A camera may shift its mosaic with the region instead of the format's name: what it says now is what it sends.
  const auto delivered = features.get_text("PixelFormat");
  if (!delivered) return delivered.error();
  const auto pattern = formats.find(*delivered == "RGB8Packed" ? "RGB8" : *delivered);
  if (pattern == formats.end() || pattern->second.has_value() != formats.at(settings.pixel_format).has_value())
    return features.refuse("pixel_format", settings.pixel_format + ", but the camera made it " + *delivered);
  AravisPicture picture{
      static_cast<int>(*width), static_cast<int>(*height), settings.pixel_format == "RGB8" ? 3 : 1, {}};
  if (pattern->second) picture.mosaic = Mosaic{*pattern->second, settings.response == AravisResponse::linear};
  return picture;
}

Result<void> apply_acquisition(const Features& features, const AravisCameraSettings& settings) {
  if (const auto set = features.set_entry_if_any("AcquisitionMode", "Continuous", "acquisition mode"); !set) return set;
  if (const auto set = features.set_entry_if_any("ExposureMode", "Timed", "exposure mode"); !set) return set;
  if (const auto set = features.set_entry_if_any("ExposureAuto", "Off", "automatic exposure"); !set) return set;
  if (const auto set = apply_exposure(features, settings.pattern_exposure_us.value_or(settings.exposure_us)); !set)
    return set;
  return apply_exposure(features, settings.exposure_us);
}

Result<void> apply_white_balance(const Features& features, const AravisCameraSettings& settings) {
  if (const auto set = features.set_entry_if_any("BalanceWhiteAuto", "Off", "automatic white balance"); !set)
    return set;
  const char* ratio = first_of(features, std::array{"BalanceRatioAbs", "BalanceRatio"});
  const auto apply = [&](const std::optional<double>& value, const char* colour, const char* setting) -> Result<void> {
    if (!value) return {};
    if (const auto set = features.set_entry("BalanceRatioSelector", colour, setting); !set) return set;
    return features.set_float(ratio, *value, setting);
  };
  if (const auto set = apply(settings.white_balance_red, "Red", "white_balance_red"); !set) return set;
  return apply(settings.white_balance_blue, "Blue", "white_balance_blue");
}

Result<void> apply_analog(const Features& features, const AravisCameraSettings& settings) {
  if (const auto set = features.set_entry_if_any("GainAuto", "Off", "automatic gain"); !set) return set;
  if (const auto set = apply_gain(features, settings.pattern_gain_db.value_or(settings.gain_db)); !set) return set;
  if (const auto set = apply_gain(features, settings.gain_db); !set) return set;
  if (const auto set = apply_white_balance(features, settings); !set) return set;

  constexpr double display_gamma = 1 / 2.2;
  const bool linear = settings.response == AravisResponse::linear && settings.pixel_format != "RGB8";
  if (features.has("GammaEnable"))
    if (const auto set = features.set_boolean("GammaEnable", !linear, "response"); !set) return set;
  if (features.has("Gamma")) return features.set_float("Gamma", linear ? 1 : display_gamma, "response");
  if (settings.response == AravisResponse::srgb)
    return Error{ErrorCode::unsupported, features.refuse("response", "srgb, but the camera has no Gamma").message};
  return {};
}

const char* name_of(AravisActivation activation) {
  switch (activation) {
    case AravisActivation::rising_edge: return "RisingEdge";
    case AravisActivation::falling_edge: return "FallingEdge";
    case AravisActivation::any_edge: return "AnyEdge";
    case AravisActivation::level_high: return "LevelHigh";
    case AravisActivation::level_low: return "LevelLow";
  }
  return "";
}

/// Which signal exposes a frame, and how; whether it is heeded at all is apply_triggered's.
Result<void> apply_trigger(const Features& features, const AravisCameraSettings& settings,
                           const AravisActionSettings& action) {
  for (const std::string& selector : features.entries("TriggerSelector")) {
    if (const auto set = features.set_entry("TriggerSelector", selector, "trigger_selector"); !set) return set;
    if (const auto set = features.set_entry_if_any("TriggerMode", "Off", "trigger mode"); !set) return set;
  }
  if (const auto set = features.set_entry("TriggerSelector", settings.trigger_selector, "trigger_selector"); !set)
    return set;
  const bool by_line = settings.trigger == AravisTriggerSource::line;
  const bool by_action = settings.trigger == AravisTriggerSource::action;
  const std::string source = by_line     ? settings.trigger_line
                             : by_action ? "Action" + std::to_string(settings.action)
                                         : "Software";
  const char* setting = by_line ? "trigger_line" : by_action ? "action" : "trigger";
  if (const auto set = features.set_entry("TriggerSource", source, setting); !set) return set;
  if (by_line)
    if (const auto set = features.set_entry("TriggerActivation", name_of(settings.activation), "activation"); !set)
      return set;
  const char* delay = first_of(features, std::array{"TriggerDelayAbs", "TriggerDelay"});
  if (settings.trigger_delay_us > 0 || features.has(delay))
    if (const auto set = features.set_float(delay, settings.trigger_delay_us, "trigger_delay_us"); !set) return set;
  if (!by_action) return {};
  if (features.has("ActionUnconditionalMode"))
    if (const auto set = features.set_entry("ActionUnconditionalMode", "On", "action"); !set) return set;
  if (const auto set = features.set_integer("ActionSelector", settings.action, "action"); !set) return set;
  if (const auto set = features.set_integer("ActionGroupKey", action.group_key, "action.group_key"); !set) return set;
  if (const auto set = features.set_integer("ActionGroupMask", action.group_mask, "action.group_mask"); !set)
    return set;
  return features.write_integer("ActionDeviceKey", action.device_key, "action.device_key");
}

}  // namespace

const char* exposure_feature(const Features& features) {
  return first_of(features, std::array{"ExposureTimeAbs", "ExposureTime"});
}

Result<void> apply_exposure(const Features& features, double exposure_us) {
  return features.set_float(exposure_feature(features), exposure_us, "exposure_us");
}

Result<void> apply_gain(const Features& features, double gain_db) {
  const char* feature = gain_feature(features);
  // Before SFNC 1.3 gain has a unit of the maker's own; what is not amplified needs none.
  if (gain_db == 0 && !features.has(feature)) return {};
  return features.set_float(feature, gain_db, "gain_db");
}

Result<void> apply_triggered(const Features& features, const AravisCameraSettings& settings) {
  // A frame rate that was meant for the preview would make the camera deaf for a while after each trigger.
  if (features.has("AcquisitionFrameRateEnable"))
    if (const auto set = features.set_boolean("AcquisitionFrameRateEnable", false, "frame rate"); !set) return set;
  if (const auto set = features.set_entry("TriggerSelector", settings.trigger_selector, "trigger_selector"); !set)
    return set;
  return features.set_entry("TriggerMode", "On", "trigger mode");
}

Result<void> apply_free_running(const Features& features, const AravisCameraSettings& settings) {
  if (const auto set = features.set_entry("TriggerMode", "Off", "trigger mode"); !set) return set;
  if (features.has("AcquisitionFrameRateEnable"))
    if (const auto set = features.set_boolean("AcquisitionFrameRateEnable", true, "preview_fps"); !set) return set;
  const char* rate = first_of(features, std::array{"AcquisitionFrameRateAbs", "AcquisitionFrameRate"});
  return features.has(rate) ? features.set_float(rate, settings.preview_fps, "preview_fps") : Result<void>{};
}

Result<AravisPicture> apply_settings(const Features& features, const AravisCameraSettings& settings,
                                     const AravisActionSettings& action) {
  if (const auto set = apply_device(features, settings); !set) return set.error();
  auto picture = apply_image_format(features, settings);
  if (!picture) return picture;
  if (const auto set = apply_acquisition(features, settings); !set) return set.error();
  if (const auto set = apply_analog(features, settings); !set) return set.error();
  if (const auto set = apply_trigger(features, settings, action); !set) return set.error();
  for (const AravisFeature& feature : settings.features)
    if (const auto set = features.set_from_text(feature.name, feature.value); !set) return set.error();
  // Features of their own may have changed what was set above.
  for (const auto& [feature, size] : {std::pair{"Width", picture->width}, std::pair{"Height", picture->height}}) {
    const auto got = features.get_integer(feature);
    if (!got) return got.error();
    if (*got != size)
      return features.refuse("features", std::string(feature) + " is " + std::to_string(*got) +
                                             " after they were set, expected " + std::to_string(size));
  }
  return picture;
}

}  // namespace booth
