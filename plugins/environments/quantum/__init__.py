"""Tasks of quantum technology: pulses, Clifford circuits, ground states and channels, each in lanes and alone."""
