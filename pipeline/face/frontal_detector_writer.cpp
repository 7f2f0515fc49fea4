// Runs while the booth is built: dlib has its frontal face detector as compressed text in a header, which takes a
// quarter of a second to unpack; saved, it is read in two thousandths. frontal_detector_writer OUT_FILE

#include <dlib/image_processing/frontal_face_detector.h>

#include <fstream>
#include <iostream>

int main(int argc, char** argv) {
  if (argc != 2) {
    std::cerr << "usage: frontal_detector_writer OUT_FILE\n";
    return 2;
  }
  std::ofstream file(argv[1], std::ios::binary);
  dlib::serialize(dlib::get_frontal_face_detector(), file);
  file.close();
  return file ? 0 : 1;
}
