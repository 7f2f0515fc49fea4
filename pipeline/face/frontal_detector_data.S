// dlib's frontal face detector as frontal_detector_writer saved it, for pipeline/face/dlib_landmarks.cpp.

  .section .rodata
  .global booth_frontal_detector, booth_frontal_detector_end
booth_frontal_detector:
  .incbin "frontal_detector.dat"
booth_frontal_detector_end:
  .byte 0

  .section .note.GNU-stack, "", %progbits
