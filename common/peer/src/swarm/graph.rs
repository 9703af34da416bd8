//! Poses of all drones from pairwise sightings, by least squares.
//!
//! A pose graph (Grisetti, Kümmerle, Stachniss, Burgard, "A Tutorial on Graph-Based SLAM", 2010).
//! The drones are its nodes, and a relative pose of two drones is an edge. Gauss-Newton moves all
//! nodes but the first, which is the origin, until the edges fit best. The inverse of the normal
//! matrix contains the covariances of the nodes, for any chains and loops of edges.

use flockeye_geometry::pose::pose_difference;
use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, Vector6};

use crate::uncertain_pose::{UncertainPose, blocks};

/// Maximum Gauss-Newton steps; two or three are enough from a chain's poses.
const STEPS: usize = 8;
/// Step size below which the search ends, m and rad.
const SMALL_STEP: f64 = 1e-7;

/// An edge of the graph: the pose of drone `to` in the frame of drone `from`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PairPose {
    /// Number of the drone in whose frame the pose is.
    pub from: usize,
    /// Number of the drone at the pose.
    pub to: usize,
    /// The pose with its covariance.
    pub from_to: UncertainPose,
}

/// A drone's pose in the frame of the first one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DroneNode {
    /// Its pose in the first drone's frame.
    pub pose: UncertainPose,
    /// The drone before it on the best chain of edges.
    pub through: usize,
}

/// The best fit to all edges.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Solution {
    /// The drones; none for drones that no edges lead to, and for the first.
    pub nodes: Vec<Option<DroneNode>>,
    /// Sum of the squared Mahalanobis distances of all usable edges.
    pub chi_square: f64,
    /// Its degrees of freedom: measured values less unknowns.
    pub degrees: usize,
}

/// Finds the poses of `drones` drones. Drone 0 is the origin.
pub(super) fn solve(drones: usize, edges: &[PairPose]) -> Solution {
    let mut nodes = chain(drones, edges);
    let is_known = |nodes: &[Option<DroneNode>], drone: usize| drone == 0 || nodes[drone].is_some();
    let usable: Vec<(&PairPose, Matrix6<f64>)> = edges
        .iter()
        .filter(|edge| is_known(&nodes, edge.from) && is_known(&nodes, edge.to))
        .filter_map(|edge| Some((edge, edge.from_to.covariance.cholesky()?.inverse())))
        .collect();
    let columns: Vec<Option<usize>> = nodes
        .iter()
        .scan(0, |next, node| {
            let column = node.is_some().then_some(*next);
            *next += 6 * usize::from(node.is_some());
            Some(column)
        })
        .collect();
    let unknowns = 6 * nodes.iter().flatten().count();
    let degrees = (6 * usable.len()).saturating_sub(unknowns);
    if unknowns == 0 {
        return Solution { nodes, chi_square: 0.0, degrees };
    }
    let mut covariance = None;
    for _ in 0..STEPS {
        let (normal, right) = linearized(&nodes, &usable, &columns, unknowns);
        let Some(factor) = normal.cholesky() else { break };
        let step = factor.solve(&right);
        for (node, column) in nodes.iter_mut().zip(&columns) {
            if let (Some(node), Some(column)) = (node, *column) {
                let error = Vector6::from_iterator(step.rows(column, 6).iter().copied());
                node.pose = node.pose.moved(&error);
            }
        }
        let is_done = step.amax() < SMALL_STEP;
        covariance = Some(factor.inverse());
        if is_done {
            break;
        }
    }
    if let Some(covariance) = covariance {
        for (node, column) in nodes.iter_mut().zip(&columns) {
            if let (Some(node), Some(column)) = (node, *column) {
                let block = covariance.fixed_view::<6, 6>(column, column).into_owned();
                node.pose.covariance = (block + block.transpose()) / 2.0;
            }
        }
    }
    let chi_square = usable
        .iter()
        .map(|(edge, weight)| {
            let residual = residual(&nodes, edge);
            residual.dot(&(weight * residual))
        })
        .sum();
    Solution { nodes, chi_square, degrees }
}

/// Initial values: each drone's pose along the chain of edges with the smallest covariance.
fn chain(drones: usize, edges: &[PairPose]) -> Vec<Option<DroneNode>> {
    let origin = UncertainPose { a_from_b: Isometry3::identity(), covariance: Matrix6::zeros() };
    let mut nodes: Vec<Option<DroneNode>> = vec![None; drones];
    loop {
        let mut best: Option<(usize, DroneNode)> = None;
        for edge in edges {
            let inverse = edge.from_to.inverse();
            for (known, new, step) in
                [(edge.from, edge.to, &edge.from_to), (edge.to, edge.from, &inverse)]
            {
                if new == 0 || nodes[new].is_some() {
                    continue;
                }
                let start = match (known, nodes[known]) {
                    (0, _) => origin,
                    (_, Some(node)) => node.pose,
                    (_, None) => continue,
                };
                let pose = start.then(step);
                let is_better = best
                    .as_ref()
                    .is_none_or(|(_, node)| pose.covariance.trace() < node.pose.covariance.trace());
                if is_better && pose.covariance.trace().is_finite() {
                    best = Some((new, DroneNode { pose, through: known }));
                }
            }
        }
        let Some((drone, node)) = best else { return nodes };
        nodes[drone] = Some(node);
    }
}

fn pose_of(nodes: &[Option<DroneNode>], drone: usize) -> Isometry3<f64> {
    nodes[drone].map_or_else(Isometry3::identity, |node| node.pose.a_from_b)
}

/// The residual of an edge: its pose less that of the nodes, in the axes of the edge's first drone.
fn residual(nodes: &[Option<DroneNode>], edge: &PairPose) -> Vector6<f64> {
    let said = pose_of(nodes, edge.from).inverse() * pose_of(nodes, edge.to);
    pose_difference(&edge.from_to.a_from_b, &said)
}

/// The normal equations at the current nodes.
fn linearized(
    nodes: &[Option<DroneNode>],
    edges: &[(&PairPose, Matrix6<f64>)],
    columns: &[Option<usize>],
    unknowns: usize,
) -> (DMatrix<f64>, DVector<f64>) {
    let mut normal = DMatrix::zeros(unknowns, unknowns);
    let mut right = DVector::zeros(unknowns);
    for (edge, weight) in edges {
        let residual = residual(nodes, edge);
        let (from, to) = (pose_of(nodes, edge.from), pose_of(nodes, edge.to));
        let turn = from.rotation.inverse().to_rotation_matrix().into_inner();
        let between = to.translation.vector - from.translation.vector;
        // With p = R_from^T (p_to - p_from) and R = R_from^T R_to, errors in the origin's axes.
        let of_to = blocks(&turn, &nalgebra::Matrix3::zeros(), &turn);
        let of_from = blocks(&-turn, &(turn * between.cross_matrix()), &-turn);
        let sides = [(columns[edge.from], of_from), (columns[edge.to], of_to)];
        for (column, jacobian) in &sides {
            let Some(column) = *column else { continue };
            let weighted = jacobian.transpose() * weight;
            let mut rows = right.rows_mut(column, 6);
            rows += weighted * residual;
            for (other, other_jacobian) in &sides {
                let Some(other) = *other else { continue };
                let mut block = normal.fixed_view_mut::<6, 6>(column, other);
                block += weighted * other_jacobian;
            }
        }
    }
    (normal, right)
}
