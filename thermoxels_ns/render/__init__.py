"""Volume rendering of rays: sampling and compositing, in plain torch and in compiled kernels."""
