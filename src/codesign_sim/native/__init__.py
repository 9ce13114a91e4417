"""C++ headers that Warp compiles into the kernels; start reading at fem.h."""
