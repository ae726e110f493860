"""L1 loss of colour and depth with its gradient (RTG-SLAM)."""
