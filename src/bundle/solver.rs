//! Cholesky solution of the reduced camera system, dense or sparse; the only place that names faer.
//!
//! Both work in memory allocated once. The sparse one finds its ordering on the blocks (approximate minimum degree on the graph
//! of slots) and keeps its symbolic factor. All is sequential: the systems are small next to the elimination, and sums must
//! not depend on the number of threads.

use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::linalg::cholesky::llt;
use faer::perm::PermRef;
use faer::sparse::linalg::amd;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::sparse::{FaerError, SparseColMatRef, SymbolicSparseColMat, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side};

use super::pattern::{Pattern, SparseRows};
use super::problem::Slot;

/// A solver of systems of one pattern.
pub(super) enum Solver {
    /// Factors in place.
    Dense {
        /// Scratch.
        memory: MemBuffer,
    },
    /// Factors beside the matrix.
    Sparse(Box<SparseSolver>),
}

/// See [`Solver::Sparse`].
pub(super) struct SparseSolver {
    pattern: SymbolicSparseColMat<usize>,
    symbolic: SymbolicCholesky<usize>,
    factor: Vec<f64>,
    memory: MemBuffer,
}

impl Solver {
    /// A solver of `num_unknowns` unknowns in these slots. Falls back on nothing: an error means that memory ran out.
    pub fn new(pattern: &Pattern, slots: &[Slot], num_unknowns: usize) -> Result<Self, FaerError> {
        match &pattern.sparse {
            None => {
                let request = StackReq::or(
                    llt::factor::cholesky_in_place_scratch::<f64>(num_unknowns, Par::Seq, Default::default()),
                    llt::solve::solve_in_place_scratch::<f64>(num_unknowns, 1, Par::Seq),
                );
                Ok(Self::Dense { memory: MemBuffer::try_new(request).map_err(|_| FaerError::OutOfMemory)? })
            }
            Some(rows) => Ok(Self::Sparse(Box::new(SparseSolver::new(rows, slots, num_unknowns)?))),
        }
    }

    /// Solves `S x = rhs` in place; `values` is `S` as the pattern stores it, and is lost. False when `S` is not positive
    /// definite.
    pub fn solve(&mut self, values: &mut [f64], rhs: &mut [f64]) -> bool {
        let n = rhs.len();
        match self {
            Self::Dense { memory } => {
                let stack = MemStack::new(memory);
                let mut matrix = MatMut::from_column_major_slice_mut(values, n, n);
                let factored = llt::factor::cholesky_in_place(
                    matrix.as_mut(),
                    Default::default(),
                    Par::Seq,
                    stack,
                    Default::default(),
                );
                if factored.is_err() {
                    return false;
                }
                let rhs = MatMut::from_column_major_slice_mut(rhs, n, 1);
                llt::solve::solve_in_place(matrix.as_ref(), rhs, Par::Seq, stack);
                true
            }
            Self::Sparse(solver) => solver.solve(values, rhs),
        }
    }
}

impl SparseSolver {
    fn new(rows: &SparseRows, slots: &[Slot], n: usize) -> Result<Self, FaerError> {
        let pattern = SymbolicSparseColMat::new_checked(n, n, rows.column_start.clone(), None, rows.rows.clone());
        let forward: Vec<usize> = block_order(&rows.neighbors)?
            .into_iter()
            .flat_map(|slot| slots[slot].first..slots[slot].first + slots[slot].len)
            .collect();
        let mut inverse = vec![0; n];
        for (to, &from) in forward.iter().enumerate() {
            inverse[from] = to;
        }
        let symbolic = factorize_symbolic_cholesky(
            pattern.as_ref(),
            Side::Lower,
            SymmetricOrdering::Custom(PermRef::new_checked(&forward, &inverse, n)),
            CholeskySymbolicParams::default(),
        )?;
        let request = StackReq::or(
            symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default()),
            symbolic.solve_in_place_scratch::<f64>(1, Par::Seq),
        );
        let memory = MemBuffer::try_new(request).map_err(|_| FaerError::OutOfMemory)?;
        let factor = vec![0.0; symbolic.len_val()];
        Ok(Self { pattern, symbolic, factor, memory })
    }

    fn solve(&mut self, values: &[f64], rhs: &mut [f64]) -> bool {
        let stack = MemStack::new(&mut self.memory);
        let factored = self.symbolic.factorize_numeric_llt(
            &mut self.factor,
            SparseColMatRef::new(self.pattern.as_ref(), values),
            Side::Lower,
            Default::default(),
            Par::Seq,
            stack,
            Default::default(),
        );
        if factored.is_err() {
            return false;
        }
        let n = rhs.len();
        LltRef::<'_, usize, f64>::new(&self.symbolic, &self.factor).solve_in_place_with_conj(
            Conj::No,
            MatMut::from_column_major_slice_mut(rhs, n, 1),
            Par::Seq,
            stack,
        );
        true
    }
}

/// An order of elimination of the slots with little fill.
fn block_order(neighbors: &[Vec<u32>]) -> Result<Vec<usize>, FaerError> {
    let n = neighbors.len();
    let mut start = vec![0];
    let mut rows = Vec::new();
    for joined in neighbors {
        rows.extend(joined.iter().map(|&row| row as usize));
        start.push(rows.len());
    }
    let (mut forward, mut inverse) = (vec![0; n], vec![0; n]);
    let mut memory = MemBuffer::try_new(amd::order_maybe_unsorted_scratch::<usize>(n, rows.len()))
        .map_err(|_| FaerError::OutOfMemory)?;
    amd::order_maybe_unsorted(
        &mut forward,
        &mut inverse,
        SymbolicSparseColMatRef::new_checked(n, n, &start, None, &rows),
        amd::Control::default(),
        MemStack::new(&mut memory),
    )?;
    Ok(forward)
}
