// Linked into every program that speaks ZeroMQ or drives cameras through Aravis, in builds for the thread sanitizer
// only.

/// libzmq is a package and not compiled with the sanitizer: the atomic operations by which its threads hand messages to
/// each other are not seen, and everything that passes through it looks like a race. Our own code is seen in full. The
/// second line would do nearly always; the first is for what is freed in one of its threads. Likewise Aravis and GLib.
extern "C" const char* __tsan_default_suppressions();  // NOLINT(bugprone-reserved-identifier): the sanitizer's name
extern "C" const char* __tsan_default_suppressions() {
  return "race:libzmq.so\ncalled_from_lib:libzmq.so\n"
         "race:libsodium.so\ncalled_from_lib:libsodium.so\n"  // by which libzmq decrypts
         "race:libaravis-0.8.so\ncalled_from_lib:libaravis-0.8.so\n"
         "race:libgobject-2.0.so\ncalled_from_lib:libgobject-2.0.so\n"
         "race:libglib-2.0.so\ncalled_from_lib:libglib-2.0.so\n"
         "race:libgio-2.0.so\ncalled_from_lib:libgio-2.0.so\n";
}
