"""From thermal camera files to degrees Celsius."""
