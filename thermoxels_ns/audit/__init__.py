"""Answers from measured surface temperatures: heat flows, U-values, thermal bridges, with intervals."""
