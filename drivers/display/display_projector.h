#pragma once

#include <memory>

#include "drivers/clock.h"
#include "drivers/display/display_settings.h"
#include "drivers/projector.h"

namespace booth {

/// A projector that tells when a pattern went out, so that the delay until it is on the subject can be measured.
class FlippingProjector : public Projector {
 public:
  /// Shows the pattern of that index without waiting for it to reach the subject.
  /// @return when the display began to scan it out, on the booth's clock. @error as show
  virtual Result<Timestamp> flip(int index) = 0;
  /// Between two frames of the display, nanoseconds.
  virtual Timestamp refresh_ns() const = 0;
};

/// Takes a display output through DRM/KMS: nothing else may draw on that card (no X server, no Wayland compositor).
/// Patterns are full-screen, one page flip each at the vertical blank; black whenever none is shown, the hardware
/// cursor is off.
///
/// The destructor leaves the output black and gives it up. The kernel does that too when the process is killed: it
/// takes the picture away and switches the output off, or brings back its text console where it has one on that card
/// (switch that off with the kernel's parameter drm_kms_helper.fbdev_emulation=0).
/// @param clock  CLOCK_MONOTONIC; outlives the projector
/// @error invalid_argument  as check(settings), or a mode or connector that is not offered, with those that are;
///        device_lost  no card or nothing connected now; busy  somebody else draws on the card; io  not permitted;
///        unsupported  the card cannot do it
Result<std::unique_ptr<FlippingProjector>> open_display_projector(const DisplaySettings& settings, const Clock& clock);

}  // namespace booth
