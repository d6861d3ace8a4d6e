"""What LPIPS computes with: AlexNet's published weights, read without trusting a pickle, and convolutions in float32."""

__all__ = ["alexnet", "convolution", "pickles"]
