"""Heat scenes: materials, effects, weather, screening and results in watts."""
