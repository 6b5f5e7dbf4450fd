"""Readers of measured data. Each returns one flat TED TensorDict of float32."""
