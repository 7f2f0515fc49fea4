// What boothd captured in the emulated machine becomes the avatar that the recording becomes which its cameras showed.

#include "tests/end_to_end/booth_process.h"

namespace booth::test {
namespace {

TEST(GuestAvatars, AreThoseOfTheRecordings) {
  const fs::path out = BOOTH_GUEST_OUT;
  if (!fs::exists(out) || fs::is_empty(out)) GTEST_SKIP() << "nothing was captured in the emulated machine";
  const ScratchFolder folder;
  for (const auto& capture : fs::directory_iterator(out)) {
    SCOPED_TRACE(capture.path().filename());
    for (const char* part : {"expected", "captured"}) {
      const fs::path said = folder.path() / "said";
      ASSERT_EQ(wait_exit(spawn({BOOTH_RECONSTRUCT, capture.path() / part, folder.path() / part}, said)), 0)
          << text_of(said);
    }
    expect_same_avatar(folder.path() / "expected", folder.path() / "captured");
    fs::remove_all(folder.path() / "expected");
    fs::remove_all(folder.path() / "captured");
  }
}

}  // namespace
}  // namespace booth::test
