"""A page in the browser to teach the arm: live scene, devices, and the loops of the command line behind them."""
