"""Files of matrices as other programs write them, for the readers."""

import gzip

import h5py
import numpy as np
import scipy.sparse as sp
from scipy.io import mmwrite, savemat


def write_matrix(path, matrix, variable="matrix"):
    """Write a matrix to the last bit, as its suffix says.

    Parameters
    ----------
    path : Path
    matrix : array_like or sparse, shape (n_dof, n_dof)
    variable : str
        Its name, in the files that have names.
    """
    matrix = sp.csr_array(matrix)
    match "".join(path.suffixes[-2:]) if path.suffix == ".gz" else path.suffix:
        case ".mtx" | ".mtx.gz" as suffix:
            with gzip.open(path, "wb") if suffix.endswith(".gz") else open(path, "wb") as file:
                mmwrite(file, matrix.tocoo(), precision=17)
        case ".npz":
            sp.save_npz(path, matrix)
        case ".npy":
            np.save(path, matrix.toarray())
        case ".csv":
            np.savetxt(path, matrix.toarray(), delimiter=",", fmt="%.17g")
        case ".mat":
            savemat(path, {variable: matrix.tocsc()})
        case ".h5" | ".hdf5":
            with h5py.File(path, "w") as file:
                group = file.create_group(variable)
                group.attrs["format"] = "csr"
                for name in ("data", "indices", "indptr", "shape"):
                    group[name] = np.asarray(getattr(matrix, name))
        case other:
            raise ValueError(f"path: must have a suffix of a matrix (got {other!r})")
