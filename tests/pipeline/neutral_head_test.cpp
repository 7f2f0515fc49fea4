#include "pipeline/face/neutral_head.h"

#include <gtest/gtest.h>

#include <string>

namespace booth {
namespace {

TEST(NeutralHead, TheOneThatIsBuiltInIsWhole) {
  const auto head = parse_neutral_head(built_in_neutral_head());
  ASSERT_TRUE(head.ok()) << head.error().message;
  const MeshTopology found = topology(head->mesh);
  EXPECT_EQ(found.components, 1U);
  EXPECT_EQ(found.euler_number, 1);
  EXPECT_EQ(head->expressions.size(), 16U);
  EXPECT_TRUE(head->landmarks[8].contour);
  EXPECT_FALSE(head->landmarks[30].contour);
  // Metres, facing +Z, the subject's left towards +X.
  const auto landmark = [&](size_t i) { return head->landmark(i, head->mesh.positions); };
  constexpr size_t chin = 8, nose_tip = 30, right_eye = 36, left_eye = 45;
  EXPECT_GT(landmark(left_eye).x() - landmark(right_eye).x(), 0.07F);
  EXPECT_LT(landmark(chin).y(), landmark(nose_tip).y());
  EXPECT_GT(landmark(nose_tip).z(), landmark(left_eye).z());
  size_t front = 0;
  for (const uint8_t inside : head->face_front) front += inside;
  EXPECT_EQ(front, 4570U);
}

TEST(NeutralHead, MirrorsIntoItself) {
  const auto head = parse_neutral_head(built_in_neutral_head());
  ASSERT_TRUE(head.ok());
  for (size_t v = 0; v < head->mesh.positions.size(); ++v) {
    const Eigen::Vector3f mirrored = head->mesh.positions[head->mirror[v]].cwiseProduct(Eigen::Vector3f(-1, 1, 1));
    EXPECT_LT((mirrored - head->mesh.positions[v]).norm(), 1e-6F) << v;
  }
}

struct Fault {
  const char* name;
  std::string_view NeutralHeadFiles::*file;
  std::string from, to;   ///< the first occurrence of `from` becomes `to`; an empty `from` stands for the whole text
  std::string complaint;  ///< what the message says
};

class NeutralHeadFault : public testing::TestWithParam<Fault> {};

TEST_P(NeutralHeadFault, IsNamed) {
  const Fault& fault = GetParam();
  NeutralHeadFiles files = built_in_neutral_head();
  std::string text(files.*fault.file);
  if (fault.from.empty()) {
    text = fault.to;
  } else {
    const size_t at = text.find(fault.from);
    ASSERT_NE(at, std::string::npos);
    text.replace(at, fault.from.size(), fault.to);
  }
  files.*fault.file = text;
  const auto head = parse_neutral_head(files);
  ASSERT_FALSE(head.ok());
  EXPECT_EQ(head.error().code, ErrorCode::invalid_file);
  EXPECT_NE(head.error().message.find(fault.complaint), std::string::npos) << head.error().message;
}

INSTANTIATE_TEST_SUITE_P(
    All, NeutralHeadFault,
    testing::Values(
        Fault{"empty_mesh", &NeutralHeadFiles::mesh, "", "", "head.obj: expected triangles"},
        Fault{"number", &NeutralHeadFiles::mesh, "v 0.0000000 -0.0011808", "v 0.0000000 nought", "head.obj: line 4"},
        Fault{"line", &NeutralHeadFiles::mesh, "o neutral_head", "curv 1 2", "head.obj: line 3: expected v, f, o"},
        Fault{"index", &NeutralHeadFiles::mesh, "\nf ", "\nf 0 1 2\nf ", "three vertex numbers from 1"},
        Fault{"quad", &NeutralHeadFiles::mesh, "\nf ", "\nf 1 2 3 4\nf ", "nothing after three values"},
        Fault{"out_of_range", &NeutralHeadFiles::mesh, "\nf ", "\nf 1 2 70000\nf ", "head.obj: "},
        Fault{"torn", &NeutralHeadFiles::mesh, "\nf ", "\nf 1 2 6000\nf ", "one manifold disk"},
        Fault{"not_json", &NeutralHeadFiles::landmarks, "", "{", "landmarks.json: not JSON"},
        Fault{"array", &NeutralHeadFiles::landmarks, "", "[]", "expected an object with \"landmarks\""},
        Fault{"too_few", &NeutralHeadFiles::landmarks, "", "{\"landmarks\": []}", "expected 68 entries, not 0"},
        Fault{"order", &NeutralHeadFiles::landmarks, "\"index\": 3,", "\"index\": 4,",
              "landmarks[3].index: expected 3"},
        Fault{"triangle", &NeutralHeadFiles::landmarks, "\"triangle\": 10897", "\"triangle\": 11962",
              "landmarks[0].triangle: expected a whole number below 11962, not 11962"},
        Fault{"weights", &NeutralHeadFiles::landmarks, "\"weights\": [0.656784,", "\"weights\": [0.756784,",
              "landmarks[0].weights"},
        Fault{"position", &NeutralHeadFiles::landmarks, "\"position\": [-0.0693644", "\"position\": [-0.0593644",
              "landmarks[0].position"},
        Fault{"landmark_mirror", &NeutralHeadFiles::landmarks, "\"mirror\": 16", "\"mirror\": 15",
              "landmarks[0].mirror: expected a landmark that mirrors back"},
        Fault{"flag", &NeutralHeadFiles::landmarks, "\"contour\": true", "\"contour\": 1", "landmarks[0].contour"},
        Fault{"symmetry_size", &NeutralHeadFiles::symmetry, "", "{\"mirror\": [0]}", "expected 6011 entries, not 1"},
        Fault{"symmetry", &NeutralHeadFiles::symmetry, "[0,1,", "[1,2,", "symmetry.json: mirror[0]"},
        Fault{"label", &NeutralHeadFiles::regions, "\"eye\",", "\"moustache\",", "labels[1]"},
        Fault{"no_label", &NeutralHeadFiles::regions, "\"vertex_label\":[3,", "\"vertex_label\":[7,",
              "vertex_label[0]: expected a whole number below 7, not 7"},
        Fault{"no_regions", &NeutralHeadFiles::regions, "", "{\"labels\": []}", "\"vertex_label\""},
        Fault{"no_shapes", &NeutralHeadFiles::expressions, "", "{\"shapes\": 3}", "shapes: expected an object"},
        Fault{"shape", &NeutralHeadFiles::expressions, "",
              R"({"shapes": {"smile": {"vertices": [2, 1], "offsets": [[0,0,0],[0,0,0]]}}})", "ascending"},
        Fault{"twice", &NeutralHeadFiles::expressions, "",
              R"({"shapes": {"smile": {"vertices": [2, 2], "offsets": [[0,0,0],[0,0,0]]}}})", "no number twice"},
        Fault{"offsets", &NeutralHeadFiles::expressions, "",
              R"({"shapes": {"smile": {"vertices": [1, 2], "offsets": [[0,0,0]]}}})",
              "shapes.smile.offsets: expected 2 entries, not 1"},
        Fault{"offset", &NeutralHeadFiles::expressions, "",
              R"({"shapes": {"smile": {"vertices": [1], "offsets": [[0,1e99,0]]}}})", "finite"}),
    [](const auto& instance) { return instance.param.name; });

}  // namespace
}  // namespace booth
