#pragma once

#include "tests/synthetic/body.h"

namespace booth::synthetic {

// People who are harder to rig than synthetic::person(), each with the joints that are known.

/// Large head, short legs: a child of about four.
Person child(double height_m = 1.1);
/// A trunk as deep as broad, thick limbs.
Person heavy_person();
/// A skirt down to the calves, wider than the shoulders at its hem.
Person in_long_skirt();
/// Hair to below the shoulders, which covers the neck from behind and from the sides.
Person with_long_hair();
/// A bag at the left hip, its strap over the right shoulder.
Person with_shoulder_bag();
/// Elbows out, hands on the hips; without joints for the hands, of which nothing can be seen.
Person with_hands_on_hips();

}  // namespace booth::synthetic
