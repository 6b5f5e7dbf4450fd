"""From a residual to the effects of a catalogue that cause it."""
