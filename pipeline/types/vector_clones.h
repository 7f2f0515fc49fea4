#pragma once

/// Before a function: it is compiled for AVX2 as well and the processor at hand decides which of both runs. They
/// compute the same, bit by bit. Not under sanitizers, which are not ready yet when the choice is made.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__) && \
    !defined(__SANITIZE_THREAD__)
#define BOOTH_VECTOR_CLONES __attribute__((target_clones("avx2", "default")))
#else
#define BOOTH_VECTOR_CLONES
#endif
