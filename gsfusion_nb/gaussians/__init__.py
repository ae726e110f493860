"""The Gaussian map and its rows."""

from .model import GaussianModel as GaussianModel
