#pragma once

#include <functional>

#include "drivers/camera.h"
#include "drivers/display/display_projector.h"
#include "drivers/trigger.h"
#include "pipeline/types/result.h"

namespace booth {

struct DelayCalibrationOptions {
  int max_delay_ms = 500;  ///< the longest delay that is tried, 10 … 2000
  int repeats = 5;         ///< pictures of each change (black to white, white to black) at each delay, 1 … 100
  double tolerance =
      0.03;  ///< of the difference between white and black, within which a picture counts as whole, 0.001 … 0.2
  int frame_timeout_ms = 2000;  ///< how long a frame may take, 50 … 60000
};

struct DelayCalibration {
  int delay_us = 0;     ///< what DisplaySettings::delay_us should be: measured, and one refresh period for safety
  int measured_us = 0;  ///< the shortest delay from which on all pictures were whole
  double contrast = 0;  ///< mean difference between white and black where the projector's light falls, of 255
  int pictures = 0;     ///< taken
};

/// Measures how long after a flip the exposure may begin so that the picture holds the new pattern only: the projector
/// changes between black and white, pictures are taken at ever closer delays (bisection down to a millisecond), and the
/// shortest delay at which all are whole is confirmed in a last round. Where the instants of pictures are not exact, it
/// is the shortest beyond all that were seen to mix patterns. The scene must hold still and see the projector; ambient
/// light may be anything that does not flicker.
///
/// @param trigger  of the camera; nullptr: the camera goes by note_trigger alone
/// @param camera   not armed; it is stopped at the end. Best with the exposure of Gray-code shots
/// @param alive    called between pictures; may be empty
/// @return the projector is dark again, also after an error
/// @error not_ready  the camera does not see the projector's light, or no delay up to max_delay_ms was long enough, or
///        steady;
///        invalid_argument  an option; what projector, trigger and camera return
/// Source: Sandia National Laboratories, OpenCSP, SOFAST: closing in on the delay until patterns mix.
Result<DelayCalibration> calibrate_delay(FlippingProjector& projector, Trigger* trigger, Camera& camera,
                                         const Clock& clock, const DelayCalibrationOptions& options = {},
                                         const std::function<void()>& alive = {});

}  // namespace booth
