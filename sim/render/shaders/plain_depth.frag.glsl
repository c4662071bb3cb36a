#version 330
// Metres along the optical axis, without a projector.

out float depth;

void main() {
    depth = 1.0 / gl_FragCoord.w;  // the fourth row of the projection is the optical axis
}
