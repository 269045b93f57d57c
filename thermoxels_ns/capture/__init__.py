"""From camera files to a scene that the dataparser reads."""
