"""From files to rays and temperatures: scenes, thermal files, synthetic scenes with known truth."""
