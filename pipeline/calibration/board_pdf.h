#pragma once

#include <array>
#include <string>
#include <string_view>
#include <utility>

#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

enum class PaperSize { a4, a3, a2, a1, a0 };

/// Every paper with its name.
inline constexpr std::array<std::pair<PaperSize, std::string_view>, 5> paper_sizes{{{PaperSize::a4, "A4"},
                                                                                    {PaperSize::a3, "A3"},
                                                                                    {PaperSize::a2, "A2"},
                                                                                    {PaperSize::a1, "A1"},
                                                                                    {PaperSize::a0, "A0"}}};

/// The board that suits a paper: 8 × 11 squares of a whole number of millimetres, as large as fit beside a ruler.
CalibrationBoard board_for(PaperSize paper);

/// A PDF file of one upright page that holds the board true to scale, as vector graphics: every square and marker cell
/// a filled shape, what it is in words, which way is up, and a ruler along its side to check the print with.
///
/// @return the file's bytes
/// @error invalid_argument  check(board) fails, or the board does not fit the paper: the message says how large it is
Result<std::string> board_pdf(const CalibrationBoard& board, PaperSize paper);

}  // namespace booth
