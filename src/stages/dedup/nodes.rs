//! The distinct L2 nodes of a sequence.

use std::collections::HashMap;

use bytemuck::{Pod, Zeroable};
use xxhash_rust::xxh3::xxh3_128;

use crate::volume::{
    Interner, NODE_CHILDREN, SCRATCH_SMALL, Scratch, ScratchError, ScratchFolder, ScratchResult,
};

/// Which of an L2 node's children exist: one bit a child, x slowest.
pub type Children = [u64; NODE_CHILDREN / 64];

/// An L2 node.
#[derive(Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Node {
    /// The place of the first child's entry in [`super::SequenceTree::runs`].
    pub run: u32,
    /// How many children there are.
    pub count: u32,
}

impl Node {
    /// The node's entries in `runs`.
    pub fn entries<'a>(&self, runs: &'a Interner<u32>) -> &'a [u32] {
        &runs.items()[self.run as usize..][..self.count as usize]
    }
}

/// Nodes by number: 8 bytes of each in memory, and which children it has in a scratch file.
pub struct Nodes {
    by_hash: HashMap<u128, u32>,
    nodes: Vec<Node>,
    children: Scratch,
}

impl Nodes {
    /// None yet, whose scratch file will be in a folder.
    pub fn new(scratch: &ScratchFolder) -> Self {
        let children = Scratch::new(scratch, size_of::<Children>(), SCRATCH_SMALL);
        Self { by_hash: HashMap::new(), nodes: Vec::new(), children }
    }

    /// The number of the node with these children, whose entries begin at `run`.
    ///
    /// # Errors
    /// When the scratch file fails.
    pub fn intern(&mut self, children: &Children, run: u32) -> ScratchResult<u32> {
        let bytes: &[u8] = bytemuck::bytes_of(children);
        let count = children.iter().map(|word| word.count_ones()).sum();
        let node = Node { run, count };
        let hash = xxh3_128(bytes) ^ u128::from(run);
        if let Some(&known) = self.by_hash.get(&hash)
            && self.nodes[known as usize] == node
            && self.children.get::<Children>(known)? == *children
        {
            return Ok(known);
        }
        let id = self.nodes.len() as u32;
        self.by_hash.entry(hash).or_insert(id);
        self.nodes.push(node);
        self.children.put(id, bytes)?;
        Ok(id)
    }

    /// Forgets what only [`Nodes::intern`] needs, and sees to it that children can be read.
    ///
    /// # Errors
    /// When the scratch file cannot be written.
    pub fn seal(&mut self) -> ScratchResult<()> {
        self.by_hash = HashMap::new();
        self.nodes.shrink_to_fit();
        self.children.flush()
    }

    /// All nodes.
    pub fn all(&self) -> &[Node] {
        &self.nodes
    }

    /// Visits all nodes in order, with their children.
    ///
    /// # Errors
    /// When the scratch file cannot be read back, or a visit fails.
    pub fn visit<E: From<ScratchError>>(
        &self,
        mut visit: impl FnMut(Node, &Children) -> Result<(), E>,
    ) -> Result<(), E> {
        let ids: Vec<u32> = (0..self.nodes.len() as u32).collect();
        for ids in ids.chunks(NODES_PER_READ) {
            for (&id, children) in ids.iter().zip(&self.children.read_as::<Children>(ids)?) {
                visit(self.nodes[id as usize], children)?;
            }
        }
        Ok(())
    }
}

/// Nodes whose children are read from the scratch file together: 64 KiB.
const NODES_PER_READ: usize = 128;
