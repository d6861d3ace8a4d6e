"""What LPIPS computes with: AlexNet's published weights, and convolutions of images in float32."""

__all__ = ["alexnet", "convolution"]
