"""What tools and experiments share: scenes that are made here, training runs, clocks, the machine, a plot."""
