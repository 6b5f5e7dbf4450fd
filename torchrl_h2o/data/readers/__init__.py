"""Readers of measured data; each returns a flat TED TensorDict of float32."""
