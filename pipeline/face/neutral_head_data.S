// The neutral head's files as they are, for pipeline/face/neutral_head.cpp.

.macro embed name, path
  .global \name, \name\()_end
\name:
  .incbin "\path"
\name\()_end:
  .byte 0
.endm

  .section .rodata
  embed booth_neutral_head_obj, "head.obj"
  embed booth_neutral_head_landmarks, "landmarks.json"
  embed booth_neutral_head_regions, "regions.json"
  embed booth_neutral_head_symmetry, "symmetry.json"
  embed booth_neutral_head_expressions, "expressions.json"

  .section .note.GNU-stack, "", %progbits
