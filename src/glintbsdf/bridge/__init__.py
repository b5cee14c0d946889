"""The Mitsuba side: base classes, parameters, registration in every variant, LLVM."""
