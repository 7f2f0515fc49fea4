#include "pipeline/calibration/board_pdf.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <vector>

#include "pipeline/calibration/board.h"

namespace booth {
namespace {

constexpr double points_per_mm = 72.0 / 25.4;
/// What printers leave white at the paper's edge.
constexpr double unprinted_mm = 8;
/// Below the board: the ruler and two lines of words.
constexpr double footer_mm = 24;

struct PaperMillimetres {
  double width, height;
};

PaperMillimetres millimetres(PaperSize paper) {
  switch (paper) {
    case PaperSize::a4: return {210, 297};
    case PaperSize::a3: return {297, 420};
    case PaperSize::a2: return {420, 594};
    case PaperSize::a1: return {594, 841};
    case PaperSize::a0: return {841, 1189};
  }
  return {210, 297};
}

/// PDF's drawing operators, in millimetres from the page's bottom left corner.
class Drawing {
 public:
  void rectangle(double x, double y, double width, double height) {
    number(x) += " ";
    number(y) += " ";
    number(width) += " ";
    number(height) += " re\n";
  }
  void fill(double grey) {
    text_ += "f\n";
    set_grey(grey);
  }
  void set_grey(double grey) { append("%.2f g\n", grey); }
  void words(double x, double y, double size_mm, const std::string& text) {
    append("BT /F1 %.3f Tf ", size_mm * points_per_mm);
    number(x) += " ";
    number(y) += " Td (";
    for (const char c : text) {
      if (c == '(' || c == ')' || c == '\\') text_ += '\\';
      text_ += c;
    }
    text_ += ") Tj ET\n";
  }
  const std::string& text() const { return text_; }

 private:
  std::string& number(double mm) { return append("%.5f", mm * points_per_mm); }
  std::string& append(const char* format, double value) {
    char text[64];
    std::snprintf(text, sizeof text, format, value);
    return text_ += text;
  }
  std::string text_;
};

std::string millimetre_text(double metres) {
  char text[32];
  std::snprintf(text, sizeof text, "%.4g mm", 1000 * metres);
  return text;
}

/// The file's objects one after the other, and where each begins, as the cross-reference table says.
std::string assemble(const std::vector<std::string>& objects) {
  // The comment's bytes tell programs that copy files that this one is binary.
  std::string file = "%PDF-1.4\n%\xE2\xE3\xCF\xD3\n";
  std::vector<size_t> starts;
  for (size_t i = 0; i < objects.size(); ++i) {
    starts.push_back(file.size());
    file += std::to_string(i + 1) + " 0 obj\n" + objects[i] + "\nendobj\n";
  }
  const size_t table = file.size();
  file += "xref\n0 " + std::to_string(objects.size() + 1) + "\n0000000000 65535 f \n";
  for (const size_t start : starts) {
    char line[32];
    std::snprintf(line, sizeof line, "%010zu 00000 n \n", start);
    file += line;
  }
  file += "trailer\n<< /Size " + std::to_string(objects.size() + 1) + " /Root 1 0 R >>\nstartxref\n" +
          std::to_string(table) + "\n%%EOF\n";
  return file;
}

/// Black squares and markers as filled rectangles. White cells are painted over their black marker.
void draw_pattern(const BoardPattern& pattern, double left_mm, double top_mm, Drawing& drawing) {
  const CalibrationBoard& board = pattern.board();
  const double square_mm = 1000 * board.square_m, marker_mm = 1000 * board.marker_m;
  drawing.set_grey(0);
  for (int y = 0; y < board.squares_y; ++y)
    for (int x = 0; x < board.squares_x; ++x)
      if (BoardPattern::black_square(x, y))
        drawing.rectangle(left_mm + x * square_mm, top_mm - (y + 1) * square_mm, square_mm, square_mm);
  for (const auto& marker : pattern.markers())
    drawing.rectangle(left_mm + 1000 * marker.corner.x(), top_mm - 1000 * marker.corner.y() - marker_mm, marker_mm,
                      marker_mm);
  drawing.fill(1);
  for (const auto& marker : pattern.markers()) {
    const double cell_mm = marker_mm / static_cast<double>(marker.white.size());
    for (size_t row = 0; row < marker.white.size(); ++row)
      for (size_t column = 0; column < marker.white.size(); ++column) {
        if (!marker.white[row][column]) continue;
        // A run of white cells is one rectangle: no hairlines between them.
        size_t end = column;
        while (end < marker.white.size() && marker.white[row][end]) ++end;
        drawing.rectangle(left_mm + 1000 * marker.corner.x() + static_cast<double>(column) * cell_mm,
                          top_mm - 1000 * marker.corner.y() - static_cast<double>(row + 1) * cell_mm,
                          static_cast<double>(end - column) * cell_mm, cell_mm);
        column = end - 1;
      }
  }
  drawing.fill(0);
}

/// Marks each millimetre, with longer ones for 5 and 10, and writes what 0 and the end are.
void draw_ruler(double left_mm, double top_mm, int length_mm, Drawing& drawing) {
  constexpr double line_mm = 0.15;
  for (int mm = 0; mm <= length_mm; ++mm) {
    const double height = mm % 10 == 0 ? 4 : mm % 5 == 0 ? 3 : 2;
    drawing.rectangle(left_mm + mm - line_mm / 2, top_mm - height, line_mm, height);
  }
  drawing.fill(0);
  for (int mm = 0; mm <= length_mm; mm += 50) drawing.words(left_mm + mm + 0.5, top_mm - 6.5, 2.5, std::to_string(mm));
}

}  // namespace

CalibrationBoard board_for(PaperSize paper) {
  const PaperMillimetres page = millimetres(paper);
  CalibrationBoard board{.squares_x = 8, .squares_y = 11, .square_m = 0, .marker_m = 0, .dictionary = "DICT_5X5_250"};
  const double square_mm = std::floor(std::min((page.width - 2 * unprinted_mm) / board.squares_x,
                                               (page.height - 2 * unprinted_mm - footer_mm) / board.squares_y));
  board.square_m = square_mm / 1000;
  board.marker_m = 0.75 * board.square_m;
  return board;
}

Result<std::string> board_pdf(const CalibrationBoard& board, PaperSize paper) {
  if (const auto valid = check(board); !valid) return valid.error();
  const PaperMillimetres page = millimetres(paper);
  const BoardPattern pattern(board);
  const double width_mm = 1000 * pattern.width_m(), height_mm = 1000 * pattern.height_m();
  if (width_mm > page.width - 2 * unprinted_mm || height_mm > page.height - 2 * unprinted_mm - footer_mm) {
    const auto name =
        std::find_if(paper_sizes.begin(), paper_sizes.end(), [&](const auto& known) { return known.first == paper; });
    char text[160];
    std::snprintf(text, sizeof text,
                  "the board is %.0f × %.0f mm and does not fit on %.*s: the printable part is %.0f × %.0f mm",
                  width_mm, height_mm, static_cast<int>(name->second.size()), name->second.data(),
                  page.width - 2 * unprinted_mm, page.height - 2 * unprinted_mm - footer_mm);
    return Error{ErrorCode::invalid_argument, text};
  }
  const double left = (page.width - width_mm) / 2;
  const double top = page.height - unprinted_mm - (page.height - 2 * unprinted_mm - footer_mm - height_mm) / 2;
  Drawing drawing;
  draw_pattern(pattern, left, top, drawing);
  const double below = top - height_mm;
  draw_ruler(left, below - 3, static_cast<int>(std::floor(width_mm / 10)) * 10, drawing);
  drawing.words(left, below - 14, 3,
                "ChArUco " + std::to_string(board.squares_x) + " x " + std::to_string(board.squares_y) + ", square " +
                    millimetre_text(board.square_m) + ", marker " + millimetre_text(board.marker_m) + ", " +
                    board.dictionary);
  drawing.words(left, below - 18, 3,
                "Print at 100 %, without fitting to the page; check the ruler; glue to a flat, stiff plate.");
  drawing.words(left, below - 22, 3, "On the floor: this edge towards where the subject looks.");

  char box[96];
  std::snprintf(box, sizeof box, "[0 0 %.4f %.4f]", page.width * points_per_mm, page.height * points_per_mm);
  const std::string& content = drawing.text();
  return assemble({"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
                   "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
                   std::string("<< /Type /Page /Parent 2 0 R /MediaBox ") + box +
                       " /Resources << /Font << /F1 5 0 R >> >> /Contents 4 0 R >>",
                   "<< /Length " + std::to_string(content.size()) + " >>\nstream\n" + content + "\nendstream",
                   "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>"});
}

}  // namespace booth
