#version 330
// Metres along the optical axis; negative where the projector's light is blocked.

uniform float projecting;  // 1 with a projector, 0 without
uniform sampler2DShadow projector_map;

in float depth_m;
in vec4 projector_place;

out float depth;

void main() {
    bool lit = true;
    if (projecting > 0.5) {
        vec3 place = projector_place.xyz / projector_place.w * 0.5 + 0.5;
        lit = texture(projector_map, vec3(place.xy, min(place.z, 1.0))) > 0.5;
    }
    depth = lit ? depth_m : -depth_m;
}
