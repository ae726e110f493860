"""D-SSIM loss with its gradient."""
