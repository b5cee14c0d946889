"""The position-normal manifold (Wu, Luan, Hašan and Ramamoorthi 2024)."""
