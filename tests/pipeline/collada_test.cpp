#include "pipeline/export/collada.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <clocale>
#include <locale>
#include <sstream>
#include <string>
#include <vector>

#include "tests/synthetic/avatar.h"

namespace booth {
namespace {

using testing::HasSubstr;
using testing::Not;

/// What stands between `begin` and `end`, which must occur after it.
std::string between(const std::string& text, const std::string& begin, const std::string& end) {
  const size_t from = text.find(begin);
  if (from == std::string::npos) return "(no " + begin + ")";
  const size_t to = text.find(end, from + begin.size());
  return text.substr(from + begin.size(), to - from - begin.size());
}

std::vector<float> numbers(const std::string& text) {
  std::vector<float> result;
  std::istringstream in(text);
  in.imbue(std::locale::classic());
  for (std::string word; in >> word;) result.push_back(std::stof(word));
  return result;
}

/// The numbers of the float_array with that id.
std::vector<float> array(const std::string& collada, const std::string& id) {
  const std::string element = between(collada, "<float_array id=\"" + id + "-array\"", "</float_array>");
  return numbers(element.substr(element.find('>') + 1));
}

TEST(Collada, HoldsEveryPositionExactly) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const std::vector<float> written = array(write_collada(avatar, {}, {}), "avatar-positions");
  ASSERT_EQ(written.size(), avatar.mesh.positions.size() * 3);
  for (size_t v = 0; v < avatar.mesh.positions.size(); ++v)
    for (size_t axis = 0; axis < 3; ++axis)
      ASSERT_EQ(written[3 * v + axis], avatar.mesh.positions[v][static_cast<int>(axis)]);
}

TEST(Collada, TurnsUvsUpsideDown) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const std::string collada = write_collada(avatar, {}, {});
  const std::vector<float> uvs = array(collada, "avatar-uvs");
  const std::vector<float> corners = numbers(between(collada, "<p>", "</p>"));
  ASSERT_EQ(corners.size(), avatar.mesh.triangles.size() * 9);
  for (size_t corner = 0; corner < avatar.mesh.triangles.size() * 3; ++corner) {
    const Eigen::Vector2f& uv = avatar.atlas.uv[corner / 3][corner % 3];
    const auto place = static_cast<size_t>(corners[3 * corner + 2]);
    ASSERT_EQ(uvs[2 * place], uv.x());
    ASSERT_NEAR(uvs[2 * place + 1], 1 - uv.y(), 1e-6);
    ASSERT_EQ(corners[3 * corner], static_cast<float>(avatar.mesh.triangles[corner / 3][corner % 3]));
  }
}

TEST(Collada, IsTheSameInEveryLocale) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const std::string expected = write_collada(avatar, {}, {});
  const std::string before = std::setlocale(LC_ALL, nullptr);
  for (const char* locale : {"de_DE.UTF-8", "fr_FR.UTF-8"})  // those with a decimal comma that are installed
    if (std::setlocale(LC_ALL, locale) != nullptr) {
      EXPECT_EQ(write_collada(avatar, {}, {}), expected);
    }
  std::setlocale(LC_ALL, before.c_str());
}

TEST(Collada, EscapesTextAndPaths) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person(), {.rigged = false});
  const std::string collada = write_collada(
      avatar, {}, {.texture_file = "my <pictures>/a&b ü.png", .authoring_tool = "A \"tool\" <1> & more\x01"});
  EXPECT_THAT(collada, HasSubstr("<init_from>my%20%3Cpictures%3E/a%26b%20%C3%BC.png</init_from>"));
  EXPECT_THAT(collada, HasSubstr("A &quot;tool&quot; &lt;1&gt; &amp; more\xef\xbf\xbd"));
}

TEST(Collada, GivesEveryJointAnIdThatXmlAllows) {
  Avatar avatar = synthetic::make_avatar(synthetic::person());
  avatar.skeleton.joints[0].name = "avatar-mesh";  // an id of the document
  avatar.skeleton.joints[1].name = "3rd bone";
  avatar.skeleton.joints[2].name = "a b";
  avatar.skeleton.joints[3].name = "a&b";
  const std::string collada = write_collada(avatar, {}, {});
  const std::string names = between(collada, "<Name_array", "</Name_array>");
  EXPECT_THAT(names, HasSubstr(">_avatar-mesh _3rd_bone a_b a_b_2 "));
  EXPECT_THAT(collada, HasSubstr("<skeleton>#_avatar-mesh</skeleton>"));
  EXPECT_THAT(collada, HasSubstr("name=\"a&amp;b\" sid=\"a_b_2\""));
}

TEST(Collada, KeepsWeightsWithinATwentyThousandth) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const std::string collada = write_collada(avatar, {}, {});
  const std::vector<float> table = array(collada, "avatar-weights");
  const std::vector<float> counts = numbers(between(collada, "<vcount>", "</vcount>"));
  const std::vector<float> pairs = numbers(between(collada, "<v>", "</v>"));
  ASSERT_EQ(counts.size(), avatar.skin.influences.size());
  size_t at = 0;
  for (size_t v = 0; v < counts.size(); ++v) {
    const JointInfluences& expected = avatar.skin.influences[v];
    for (size_t k = 0; k < static_cast<size_t>(counts[v]); ++k, at += 2) {
      ASSERT_EQ(pairs[at], expected.joint[k]);
      ASSERT_NEAR(table[static_cast<size_t>(pairs[at + 1])], expected.weight[k], 5e-5);
    }
  }
  EXPECT_EQ(at, pairs.size());
}

TEST(Collada, DropsWeightsTooSmallToMatter) {
  Avatar avatar = synthetic::make_avatar(synthetic::person());
  avatar.skin.influences[0] = {{2, 5, 1, 0}, {1, 1e-6F, 1e-7F, 0}};
  ASSERT_TRUE(check(avatar));
  const std::string counts = between(write_collada(avatar, {}, {}), "<vcount>", "</vcount>");
  EXPECT_EQ(counts.substr(0, 2), "1 ");
}

TEST(Collada, OfAnUnriggedAvatarHasNoController) {
  const std::string collada = write_collada(synthetic::make_avatar(synthetic::person(), {.rigged = false}), {}, {});
  EXPECT_THAT(collada, Not(HasSubstr("controller")));
  EXPECT_THAT(collada, Not(HasSubstr("JOINT")));
  EXPECT_THAT(collada, HasSubstr("<instance_geometry url=\"#avatar-mesh\">"));
}

TEST(Collada, HoldsMorphTargetsWhereAskedFor) {
  Avatar avatar = synthetic::make_avatar(synthetic::person());
  avatar.morphs = {{"smile", {3, 7}, {{0.25F, 0, 0}, {0, -0.5F, 0}}}, {"a wink", {}, {}}, {"a&wink", {}, {}}};
  EXPECT_THAT(write_collada(avatar, {}, {}), Not(HasSubstr("morph")));

  const std::string collada = write_collada(avatar, {}, {.morphs = true});
  EXPECT_THAT(collada, HasSubstr(">avatar-shape-smile avatar-shape-a_wink avatar-shape-a_wink_2</IDREF_array>"));
  EXPECT_THAT(collada, HasSubstr("<geometry id=\"avatar-shape-a_wink_2\" name=\"a&amp;wink\">"));
  EXPECT_THAT(collada, HasSubstr("<morph source=\"#avatar-mesh\" method=\"NORMALIZED\">"));
  EXPECT_THAT(collada, HasSubstr("<skin source=\"#avatar-mesh\">"));
  EXPECT_THAT(array(collada, "avatar-morph-weights"), testing::Each(0));
  EXPECT_EQ(array(collada, "avatar-shape-a_wink-positions"), array(collada, "avatar-positions"));
  std::vector<Eigen::Vector3f> moved = avatar.mesh.positions;
  moved[3].x() += 0.25F;
  moved[7].y() -= 0.5F;
  const std::vector<float> written = array(collada, "avatar-shape-smile-positions");
  ASSERT_EQ(written.size(), moved.size() * 3);
  for (size_t v = 0; v < moved.size(); ++v)
    for (size_t axis = 0; axis < 3; ++axis) ASSERT_EQ(written[3 * v + axis], moved[v][static_cast<int>(axis)]);
}

TEST(Collada, WritesUnitNormalsWhereThereIsNoArea) {
  Avatar avatar;
  avatar.mesh.positions = {{0, 0, 0}, {1, 0, 0}, {2, 0, 0}};
  avatar.mesh.triangles = {{0, 1, 2}};
  avatar.atlas = {Image(2, 2, 3), {{Eigen::Vector2f(0, 0), Eigen::Vector2f(1, 0), Eigen::Vector2f(1, 1)}}};
  EXPECT_THAT(array(write_collada(avatar, {}, {}), "avatar-normals"), testing::ElementsAre(0, 1, 0, 0, 1, 0, 0, 1, 0));
}

}  // namespace
}  // namespace booth
