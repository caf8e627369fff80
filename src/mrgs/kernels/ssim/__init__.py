"""Losses that compare images by SSIM: photometric loss and L_boltz."""
