/* The wire of Fathomlink in C99, header only; see protocol/WIRE.md.
 *
 * Made from protocol/layouts.py by: python -m protocol.c_header
 * Layout version 1, fingerprint ed3d91bc69b9bc4e. No allocation, no globals that change, any input accepted.
 */
#ifndef FATHOMLINK_WIRE_H
#define FATHOMLINK_WIRE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define FL_VERSION 1
#define FL_FINGERPRINT "ed3d91bc69b9bc4e"
#define FL_HEADER_BYTES 8
#define FL_CRC_BYTES 4
#define FL_SEAL_BYTES 12
#define FL_LARGEST_FRAME_BYTES 256
#define FL_LARGEST_LINE_BYTES 260

enum fl_profile {
    FL_SUBMAP_PAPER = 1,
    FL_ANSWER = 2,
    FL_TRAJECTORY = 3,
    FL_SUBMAP_DENSE = 4,
    FL_SUBMAP_LATTICE = 5,
    FL_SUBMAP_LATTICE_SMALL = 6,
    FL_ANSWER_EXTENDED = 7,
    FL_TRAJECTORY_SMALL = 8,
    FL_SEALED_SUBMAP_PAPER = 17,
    FL_SEALED_ANSWER = 18,
    FL_SEALED_TRAJECTORY = 19,
    FL_SEALED_SUBMAP_DENSE = 20,
    FL_SEALED_SUBMAP_LATTICE = 21,
    FL_SEALED_SUBMAP_LATTICE_SMALL = 22,
    FL_SEALED_ANSWER_EXTENDED = 23,
    FL_SEALED_TRAJECTORY_SMALL = 24
};

/* What fl_decode returns: the causes of protocol/WIRE.md, in the order in which they are looked for. */
enum fl_result { FL_OK, FL_SIZE, FL_CRC, FL_OTHER_VERSION, FL_OTHER_PROFILE, FL_LAYOUT };

struct fl_header {
    uint8_t version, profile, vehicle, boot_epoch, fragment, fragment_count, tx_second;
    uint16_t submap;
    uint32_t time_quarters;
};

struct fl_submap_paper {
    float trajectory[12];
    float points_ned_m[45];
    float hyperparameters[4];
};

struct fl_answer {
    uint16_t submap;
    float north_m;
    float east_m;
};

struct fl_trajectory {
    float states[60];
};

struct fl_submap_dense {
    uint8_t body[244];
};

struct fl_submap_lattice {
    uint8_t body[244];
};

struct fl_submap_lattice_small {
    uint8_t body[50];
};

struct fl_answer_extended {
    uint16_t submap;
    float north_m;
    float east_m;
    float variance_m2;
    float leader_north_m;
    float leader_east_m;
    float leader_variance_m2;
    uint16_t repeat_submap;
    uint16_t missing_fragments;
};

struct fl_trajectory_small {
    float states[12];
};

struct fl_sealed_submap_paper {
    float trajectory[12];
    float points_ned_m[42];
    float hyperparameters[4];
};

struct fl_sealed_answer {
    uint16_t submap;
    float north_m;
    float east_m;
};

struct fl_sealed_trajectory {
    float states[57];
};

struct fl_sealed_submap_dense {
    uint8_t body[232];
};

struct fl_sealed_submap_lattice {
    uint8_t body[232];
};

struct fl_sealed_submap_lattice_small {
    uint8_t body[38];
};

struct fl_sealed_answer_extended {
    uint16_t submap;
    float north_m;
    float east_m;
    float variance_m2;
    float leader_north_m;
    float leader_east_m;
    float leader_variance_m2;
    uint16_t repeat_submap;
    uint16_t missing_fragments;
};

struct fl_sealed_trajectory_small {
    float states[9];
};

union fl_body {
    struct fl_submap_paper submap_paper;
    struct fl_answer answer;
    struct fl_trajectory trajectory;
    struct fl_submap_dense submap_dense;
    struct fl_submap_lattice submap_lattice;
    struct fl_submap_lattice_small submap_lattice_small;
    struct fl_answer_extended answer_extended;
    struct fl_trajectory_small trajectory_small;
    struct fl_sealed_submap_paper sealed_submap_paper;
    struct fl_sealed_answer sealed_answer;
    struct fl_sealed_trajectory sealed_trajectory;
    struct fl_sealed_submap_dense sealed_submap_dense;
    struct fl_sealed_submap_lattice sealed_submap_lattice;
    struct fl_sealed_submap_lattice_small sealed_submap_lattice_small;
    struct fl_sealed_answer_extended sealed_answer_extended;
    struct fl_sealed_trajectory_small sealed_trajectory_small;
};

/* body is set for plain profiles; sealed_body, counter and tag for sealed ones, until the tag was verified: then
 * fl_read_body gives the body. */
struct fl_packet {
    struct fl_header header;
    union fl_body body;
    uint8_t sealed_body[232];
    uint32_t counter;
    uint8_t tag[8];
};

/* Bytes of the body, without seal and CRC; 0 for a profile that is not listed. */
static inline size_t fl_body_bytes(unsigned profile) {
    switch (profile) {
    case FL_SUBMAP_PAPER: return 244;
    case FL_ANSWER: return 10;
    case FL_TRAJECTORY: return 244;
    case FL_SUBMAP_DENSE: return 244;
    case FL_SUBMAP_LATTICE: return 244;
    case FL_SUBMAP_LATTICE_SMALL: return 50;
    case FL_ANSWER_EXTENDED: return 30;
    case FL_TRAJECTORY_SMALL: return 50;
    case FL_SEALED_SUBMAP_PAPER: return 232;
    case FL_SEALED_ANSWER: return 10;
    case FL_SEALED_TRAJECTORY: return 232;
    case FL_SEALED_SUBMAP_DENSE: return 232;
    case FL_SEALED_SUBMAP_LATTICE: return 232;
    case FL_SEALED_SUBMAP_LATTICE_SMALL: return 38;
    case FL_SEALED_ANSWER_EXTENDED: return 30;
    case FL_SEALED_TRAJECTORY_SMALL: return 38;
    default: return 0;
    }
}

static inline size_t fl_frame_bytes(unsigned profile) {
    size_t body = fl_body_bytes(profile);
    return body == 0 ? 0 : FL_HEADER_BYTES + body + (profile >= 16 ? FL_SEAL_BYTES : 0) + FL_CRC_BYTES;
}

static inline uint32_t fl_crc32c(const uint8_t *data, size_t size) {
    static const uint32_t table[256] = {
        0x00000000u, 0xF26B8303u, 0xE13B70F7u, 0x1350F3F4u, 0xC79A971Fu, 0x35F1141Cu,
        0x26A1E7E8u, 0xD4CA64EBu, 0x8AD958CFu, 0x78B2DBCCu, 0x6BE22838u, 0x9989AB3Bu,
        0x4D43CFD0u, 0xBF284CD3u, 0xAC78BF27u, 0x5E133C24u, 0x105EC76Fu, 0xE235446Cu,
        0xF165B798u, 0x030E349Bu, 0xD7C45070u, 0x25AFD373u, 0x36FF2087u, 0xC494A384u,
        0x9A879FA0u, 0x68EC1CA3u, 0x7BBCEF57u, 0x89D76C54u, 0x5D1D08BFu, 0xAF768BBCu,
        0xBC267848u, 0x4E4DFB4Bu, 0x20BD8EDEu, 0xD2D60DDDu, 0xC186FE29u, 0x33ED7D2Au,
        0xE72719C1u, 0x154C9AC2u, 0x061C6936u, 0xF477EA35u, 0xAA64D611u, 0x580F5512u,
        0x4B5FA6E6u, 0xB93425E5u, 0x6DFE410Eu, 0x9F95C20Du, 0x8CC531F9u, 0x7EAEB2FAu,
        0x30E349B1u, 0xC288CAB2u, 0xD1D83946u, 0x23B3BA45u, 0xF779DEAEu, 0x05125DADu,
        0x1642AE59u, 0xE4292D5Au, 0xBA3A117Eu, 0x4851927Du, 0x5B016189u, 0xA96AE28Au,
        0x7DA08661u, 0x8FCB0562u, 0x9C9BF696u, 0x6EF07595u, 0x417B1DBCu, 0xB3109EBFu,
        0xA0406D4Bu, 0x522BEE48u, 0x86E18AA3u, 0x748A09A0u, 0x67DAFA54u, 0x95B17957u,
        0xCBA24573u, 0x39C9C670u, 0x2A993584u, 0xD8F2B687u, 0x0C38D26Cu, 0xFE53516Fu,
        0xED03A29Bu, 0x1F682198u, 0x5125DAD3u, 0xA34E59D0u, 0xB01EAA24u, 0x42752927u,
        0x96BF4DCCu, 0x64D4CECFu, 0x77843D3Bu, 0x85EFBE38u, 0xDBFC821Cu, 0x2997011Fu,
        0x3AC7F2EBu, 0xC8AC71E8u, 0x1C661503u, 0xEE0D9600u, 0xFD5D65F4u, 0x0F36E6F7u,
        0x61C69362u, 0x93AD1061u, 0x80FDE395u, 0x72966096u, 0xA65C047Du, 0x5437877Eu,
        0x4767748Au, 0xB50CF789u, 0xEB1FCBADu, 0x197448AEu, 0x0A24BB5Au, 0xF84F3859u,
        0x2C855CB2u, 0xDEEEDFB1u, 0xCDBE2C45u, 0x3FD5AF46u, 0x7198540Du, 0x83F3D70Eu,
        0x90A324FAu, 0x62C8A7F9u, 0xB602C312u, 0x44694011u, 0x5739B3E5u, 0xA55230E6u,
        0xFB410CC2u, 0x092A8FC1u, 0x1A7A7C35u, 0xE811FF36u, 0x3CDB9BDDu, 0xCEB018DEu,
        0xDDE0EB2Au, 0x2F8B6829u, 0x82F63B78u, 0x709DB87Bu, 0x63CD4B8Fu, 0x91A6C88Cu,
        0x456CAC67u, 0xB7072F64u, 0xA457DC90u, 0x563C5F93u, 0x082F63B7u, 0xFA44E0B4u,
        0xE9141340u, 0x1B7F9043u, 0xCFB5F4A8u, 0x3DDE77ABu, 0x2E8E845Fu, 0xDCE5075Cu,
        0x92A8FC17u, 0x60C37F14u, 0x73938CE0u, 0x81F80FE3u, 0x55326B08u, 0xA759E80Bu,
        0xB4091BFFu, 0x466298FCu, 0x1871A4D8u, 0xEA1A27DBu, 0xF94AD42Fu, 0x0B21572Cu,
        0xDFEB33C7u, 0x2D80B0C4u, 0x3ED04330u, 0xCCBBC033u, 0xA24BB5A6u, 0x502036A5u,
        0x4370C551u, 0xB11B4652u, 0x65D122B9u, 0x97BAA1BAu, 0x84EA524Eu, 0x7681D14Du,
        0x2892ED69u, 0xDAF96E6Au, 0xC9A99D9Eu, 0x3BC21E9Du, 0xEF087A76u, 0x1D63F975u,
        0x0E330A81u, 0xFC588982u, 0xB21572C9u, 0x407EF1CAu, 0x532E023Eu, 0xA145813Du,
        0x758FE5D6u, 0x87E466D5u, 0x94B49521u, 0x66DF1622u, 0x38CC2A06u, 0xCAA7A905u,
        0xD9F75AF1u, 0x2B9CD9F2u, 0xFF56BD19u, 0x0D3D3E1Au, 0x1E6DCDEEu, 0xEC064EEDu,
        0xC38D26C4u, 0x31E6A5C7u, 0x22B65633u, 0xD0DDD530u, 0x0417B1DBu, 0xF67C32D8u,
        0xE52CC12Cu, 0x1747422Fu, 0x49547E0Bu, 0xBB3FFD08u, 0xA86F0EFCu, 0x5A048DFFu,
        0x8ECEE914u, 0x7CA56A17u, 0x6FF599E3u, 0x9D9E1AE0u, 0xD3D3E1ABu, 0x21B862A8u,
        0x32E8915Cu, 0xC083125Fu, 0x144976B4u, 0xE622F5B7u, 0xF5720643u, 0x07198540u,
        0x590AB964u, 0xAB613A67u, 0xB831C993u, 0x4A5A4A90u, 0x9E902E7Bu, 0x6CFBAD78u,
        0x7FAB5E8Cu, 0x8DC0DD8Fu, 0xE330A81Au, 0x115B2B19u, 0x020BD8EDu, 0xF0605BEEu,
        0x24AA3F05u, 0xD6C1BC06u, 0xC5914FF2u, 0x37FACCF1u, 0x69E9F0D5u, 0x9B8273D6u,
        0x88D28022u, 0x7AB90321u, 0xAE7367CAu, 0x5C18E4C9u, 0x4F48173Du, 0xBD23943Eu,
        0xF36E6F75u, 0x0105EC76u, 0x12551F82u, 0xE03E9C81u, 0x34F4F86Au, 0xC69F7B69u,
        0xD5CF889Du, 0x27A40B9Eu, 0x79B737BAu, 0x8BDCB4B9u, 0x988C474Du, 0x6AE7C44Eu,
        0xBE2DA0A5u, 0x4C4623A6u, 0x5F16D052u, 0xAD7D5351u,
    };
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < size; i++) crc = crc >> 8 ^ table[(crc ^ data[i]) & 0xFF];
    return crc ^ 0xFFFFFFFFu;
}

static inline uint16_t fl_get_u2(const uint8_t *at) { return (uint16_t)(at[0] << 8 | at[1]); }

static inline uint32_t fl_get_u4(const uint8_t *at) {
    return (uint32_t)at[0] << 24 | (uint32_t)at[1] << 16 | (uint32_t)at[2] << 8 | at[3];
}

static inline void fl_put_u2(uint8_t *at, uint16_t value) {
    at[0] = (uint8_t)(value >> 8);
    at[1] = (uint8_t)value;
}

static inline void fl_put_u4(uint8_t *at, uint32_t value) {
    fl_put_u2(at, (uint16_t)(value >> 16));
    fl_put_u2(at + 2, (uint16_t)value);
}

static inline void fl_get_f4(const uint8_t *at, float *values, size_t count) {
    for (size_t i = 0; i < count; i++) {
        uint32_t bits = fl_get_u4(at + 4 * i);
        memcpy(values + i, &bits, 4);
    }
}

static inline void fl_put_f4(uint8_t *at, const float *values, size_t count) {
    for (size_t i = 0; i < count; i++) {
        uint32_t bits;
        memcpy(&bits, values + i, 4);
        fl_put_u4(at + 4 * i, bits);
    }
}

/* Without <math.h>: neither NaN nor infinite. */
static inline int fl_is_finite(float value) {
    uint32_t bits;
    memcpy(&bits, &value, 4);
    return (bits & 0x7F800000u) != 0x7F800000u;
}

static inline void fl_get_header(const uint8_t *at, struct fl_header *header) {
    header->version = at[0] >> 5;
    header->profile = at[0] & 31;
    header->vehicle = at[1] >> 4;
    header->boot_epoch = at[1] & 15;
    header->submap = fl_get_u2(at + 2);
    header->fragment = at[4] >> 4;
    header->fragment_count = at[4] & 15;
    header->tx_second = at[5] >> 4;
    header->time_quarters = (uint32_t)(at[5] & 15) << 16 | fl_get_u2(at + 6);
}

static inline void fl_put_header(uint8_t *at, const struct fl_header *header) {
    at[0] = (uint8_t)(header->version << 5 | (header->profile & 31));
    at[1] = (uint8_t)(header->vehicle << 4 | (header->boot_epoch & 15));
    fl_put_u2(at + 2, header->submap);
    at[4] = (uint8_t)(header->fragment << 4 | (header->fragment_count & 15));
    at[5] = (uint8_t)(header->tx_second << 4 | (header->time_quarters >> 16 & 15));
    fl_put_u2(at + 6, (uint16_t)header->time_quarters);
}

/* Read a body of fl_body_bytes(header->profile) bytes; FL_OK or FL_LAYOUT. */
static inline enum fl_result fl_read_body(
    const struct fl_header *header, const uint8_t *at, union fl_body *body) {
    unsigned plain = header->profile & 15u;
    if (plain != FL_ANSWER && plain != FL_ANSWER_EXTENDED && header->fragment >= header->fragment_count)
        return FL_LAYOUT;
    switch (header->profile) {
    case FL_SUBMAP_PAPER: {
        struct fl_submap_paper *to = &body->submap_paper;
        fl_get_f4(at + 0, to->trajectory, 12);
        fl_get_f4(at + 48, to->points_ned_m, 45);
        fl_get_f4(at + 228, to->hyperparameters, 4);
        break;
    }
    case FL_ANSWER: {
        struct fl_answer *to = &body->answer;
        to->submap = fl_get_u2(at + 0);
        fl_get_f4(at + 2, &to->north_m, 1);
        if (!fl_is_finite(to->north_m)) return FL_LAYOUT;
        fl_get_f4(at + 6, &to->east_m, 1);
        if (!fl_is_finite(to->east_m)) return FL_LAYOUT;
        break;
    }
    case FL_TRAJECTORY: {
        struct fl_trajectory *to = &body->trajectory;
        fl_get_f4(at + 0, to->states, 60);
        for (size_t i = 0; i < 4; i++)
            if (at[240 + i] != 0) return FL_LAYOUT;
        break;
    }
    case FL_SUBMAP_DENSE: {
        struct fl_submap_dense *to = &body->submap_dense;
        memcpy(to->body, at + 0, 244);
        break;
    }
    case FL_SUBMAP_LATTICE: {
        struct fl_submap_lattice *to = &body->submap_lattice;
        memcpy(to->body, at + 0, 244);
        break;
    }
    case FL_SUBMAP_LATTICE_SMALL: {
        struct fl_submap_lattice_small *to = &body->submap_lattice_small;
        memcpy(to->body, at + 0, 50);
        break;
    }
    case FL_ANSWER_EXTENDED: {
        struct fl_answer_extended *to = &body->answer_extended;
        to->submap = fl_get_u2(at + 0);
        fl_get_f4(at + 2, &to->north_m, 1);
        if (!fl_is_finite(to->north_m)) return FL_LAYOUT;
        fl_get_f4(at + 6, &to->east_m, 1);
        if (!fl_is_finite(to->east_m)) return FL_LAYOUT;
        fl_get_f4(at + 10, &to->variance_m2, 1);
        if (!(to->variance_m2 >= 0.0f)) return FL_LAYOUT;
        fl_get_f4(at + 14, &to->leader_north_m, 1);
        if (!fl_is_finite(to->leader_north_m)) return FL_LAYOUT;
        fl_get_f4(at + 18, &to->leader_east_m, 1);
        if (!fl_is_finite(to->leader_east_m)) return FL_LAYOUT;
        fl_get_f4(at + 22, &to->leader_variance_m2, 1);
        if (!(to->leader_variance_m2 >= 0.0f)) return FL_LAYOUT;
        to->repeat_submap = fl_get_u2(at + 26);
        to->missing_fragments = fl_get_u2(at + 28);
        break;
    }
    case FL_TRAJECTORY_SMALL: {
        struct fl_trajectory_small *to = &body->trajectory_small;
        fl_get_f4(at + 0, to->states, 12);
        for (size_t i = 0; i < 2; i++)
            if (at[48 + i] != 0) return FL_LAYOUT;
        break;
    }
    case FL_SEALED_SUBMAP_PAPER: {
        struct fl_sealed_submap_paper *to = &body->sealed_submap_paper;
        fl_get_f4(at + 0, to->trajectory, 12);
        fl_get_f4(at + 48, to->points_ned_m, 42);
        fl_get_f4(at + 216, to->hyperparameters, 4);
        break;
    }
    case FL_SEALED_ANSWER: {
        struct fl_sealed_answer *to = &body->sealed_answer;
        to->submap = fl_get_u2(at + 0);
        fl_get_f4(at + 2, &to->north_m, 1);
        if (!fl_is_finite(to->north_m)) return FL_LAYOUT;
        fl_get_f4(at + 6, &to->east_m, 1);
        if (!fl_is_finite(to->east_m)) return FL_LAYOUT;
        break;
    }
    case FL_SEALED_TRAJECTORY: {
        struct fl_sealed_trajectory *to = &body->sealed_trajectory;
        fl_get_f4(at + 0, to->states, 57);
        for (size_t i = 0; i < 4; i++)
            if (at[228 + i] != 0) return FL_LAYOUT;
        break;
    }
    case FL_SEALED_SUBMAP_DENSE: {
        struct fl_sealed_submap_dense *to = &body->sealed_submap_dense;
        memcpy(to->body, at + 0, 232);
        break;
    }
    case FL_SEALED_SUBMAP_LATTICE: {
        struct fl_sealed_submap_lattice *to = &body->sealed_submap_lattice;
        memcpy(to->body, at + 0, 232);
        break;
    }
    case FL_SEALED_SUBMAP_LATTICE_SMALL: {
        struct fl_sealed_submap_lattice_small *to = &body->sealed_submap_lattice_small;
        memcpy(to->body, at + 0, 38);
        break;
    }
    case FL_SEALED_ANSWER_EXTENDED: {
        struct fl_sealed_answer_extended *to = &body->sealed_answer_extended;
        to->submap = fl_get_u2(at + 0);
        fl_get_f4(at + 2, &to->north_m, 1);
        if (!fl_is_finite(to->north_m)) return FL_LAYOUT;
        fl_get_f4(at + 6, &to->east_m, 1);
        if (!fl_is_finite(to->east_m)) return FL_LAYOUT;
        fl_get_f4(at + 10, &to->variance_m2, 1);
        if (!(to->variance_m2 >= 0.0f)) return FL_LAYOUT;
        fl_get_f4(at + 14, &to->leader_north_m, 1);
        if (!fl_is_finite(to->leader_north_m)) return FL_LAYOUT;
        fl_get_f4(at + 18, &to->leader_east_m, 1);
        if (!fl_is_finite(to->leader_east_m)) return FL_LAYOUT;
        fl_get_f4(at + 22, &to->leader_variance_m2, 1);
        if (!(to->leader_variance_m2 >= 0.0f)) return FL_LAYOUT;
        to->repeat_submap = fl_get_u2(at + 26);
        to->missing_fragments = fl_get_u2(at + 28);
        break;
    }
    case FL_SEALED_TRAJECTORY_SMALL: {
        struct fl_sealed_trajectory_small *to = &body->sealed_trajectory_small;
        fl_get_f4(at + 0, to->states, 9);
        for (size_t i = 0; i < 2; i++)
            if (at[36 + i] != 0) return FL_LAYOUT;
        break;
    }
    default: return FL_OTHER_PROFILE;
    }
    return FL_OK;
}

static inline void fl_write_body(unsigned profile, const union fl_body *body, uint8_t *at) {
    switch (profile) {
    case FL_SUBMAP_PAPER: {
        const struct fl_submap_paper *from = &body->submap_paper;
        fl_put_f4(at + 0, from->trajectory, 12);
        fl_put_f4(at + 48, from->points_ned_m, 45);
        fl_put_f4(at + 228, from->hyperparameters, 4);
        break;
    }
    case FL_ANSWER: {
        const struct fl_answer *from = &body->answer;
        fl_put_u2(at + 0, from->submap);
        fl_put_f4(at + 2, &from->north_m, 1);
        fl_put_f4(at + 6, &from->east_m, 1);
        break;
    }
    case FL_TRAJECTORY: {
        const struct fl_trajectory *from = &body->trajectory;
        fl_put_f4(at + 0, from->states, 60);
        memset(at + 240, 0, 4);
        break;
    }
    case FL_SUBMAP_DENSE: {
        const struct fl_submap_dense *from = &body->submap_dense;
        memcpy(at + 0, from->body, 244);
        break;
    }
    case FL_SUBMAP_LATTICE: {
        const struct fl_submap_lattice *from = &body->submap_lattice;
        memcpy(at + 0, from->body, 244);
        break;
    }
    case FL_SUBMAP_LATTICE_SMALL: {
        const struct fl_submap_lattice_small *from = &body->submap_lattice_small;
        memcpy(at + 0, from->body, 50);
        break;
    }
    case FL_ANSWER_EXTENDED: {
        const struct fl_answer_extended *from = &body->answer_extended;
        fl_put_u2(at + 0, from->submap);
        fl_put_f4(at + 2, &from->north_m, 1);
        fl_put_f4(at + 6, &from->east_m, 1);
        fl_put_f4(at + 10, &from->variance_m2, 1);
        fl_put_f4(at + 14, &from->leader_north_m, 1);
        fl_put_f4(at + 18, &from->leader_east_m, 1);
        fl_put_f4(at + 22, &from->leader_variance_m2, 1);
        fl_put_u2(at + 26, from->repeat_submap);
        fl_put_u2(at + 28, from->missing_fragments);
        break;
    }
    case FL_TRAJECTORY_SMALL: {
        const struct fl_trajectory_small *from = &body->trajectory_small;
        fl_put_f4(at + 0, from->states, 12);
        memset(at + 48, 0, 2);
        break;
    }
    case FL_SEALED_SUBMAP_PAPER: {
        const struct fl_sealed_submap_paper *from = &body->sealed_submap_paper;
        fl_put_f4(at + 0, from->trajectory, 12);
        fl_put_f4(at + 48, from->points_ned_m, 42);
        fl_put_f4(at + 216, from->hyperparameters, 4);
        break;
    }
    case FL_SEALED_ANSWER: {
        const struct fl_sealed_answer *from = &body->sealed_answer;
        fl_put_u2(at + 0, from->submap);
        fl_put_f4(at + 2, &from->north_m, 1);
        fl_put_f4(at + 6, &from->east_m, 1);
        break;
    }
    case FL_SEALED_TRAJECTORY: {
        const struct fl_sealed_trajectory *from = &body->sealed_trajectory;
        fl_put_f4(at + 0, from->states, 57);
        memset(at + 228, 0, 4);
        break;
    }
    case FL_SEALED_SUBMAP_DENSE: {
        const struct fl_sealed_submap_dense *from = &body->sealed_submap_dense;
        memcpy(at + 0, from->body, 232);
        break;
    }
    case FL_SEALED_SUBMAP_LATTICE: {
        const struct fl_sealed_submap_lattice *from = &body->sealed_submap_lattice;
        memcpy(at + 0, from->body, 232);
        break;
    }
    case FL_SEALED_SUBMAP_LATTICE_SMALL: {
        const struct fl_sealed_submap_lattice_small *from = &body->sealed_submap_lattice_small;
        memcpy(at + 0, from->body, 38);
        break;
    }
    case FL_SEALED_ANSWER_EXTENDED: {
        const struct fl_sealed_answer_extended *from = &body->sealed_answer_extended;
        fl_put_u2(at + 0, from->submap);
        fl_put_f4(at + 2, &from->north_m, 1);
        fl_put_f4(at + 6, &from->east_m, 1);
        fl_put_f4(at + 10, &from->variance_m2, 1);
        fl_put_f4(at + 14, &from->leader_north_m, 1);
        fl_put_f4(at + 18, &from->leader_east_m, 1);
        fl_put_f4(at + 22, &from->leader_variance_m2, 1);
        fl_put_u2(at + 26, from->repeat_submap);
        fl_put_u2(at + 28, from->missing_fragments);
        break;
    }
    case FL_SEALED_TRAJECTORY_SMALL: {
        const struct fl_sealed_trajectory_small *from = &body->sealed_trajectory_small;
        fl_put_f4(at + 0, from->states, 9);
        memset(at + 36, 0, 2);
        break;
    }
    default: break;
    }
}

/* Read a frame; on anything but FL_OK only what the header claims is set, and only from FL_CRC on. */
static inline enum fl_result fl_decode(const uint8_t *frame, size_t size, struct fl_packet *packet) {
    if (size < FL_HEADER_BYTES + FL_CRC_BYTES) return FL_SIZE;
    const uint8_t *end = frame + size - FL_CRC_BYTES;
    uint32_t crc = (uint32_t)end[3] << 24 | (uint32_t)end[2] << 16 | (uint32_t)end[1] << 8 | end[0];
    fl_get_header(frame, &packet->header);
    if (crc != fl_crc32c(frame, size - FL_CRC_BYTES)) return FL_CRC;
    if (packet->header.version != FL_VERSION) return FL_OTHER_VERSION;
    unsigned profile = packet->header.profile;
    if (fl_body_bytes(profile) == 0) return FL_OTHER_PROFILE;
    if (size != fl_frame_bytes(profile)) return FL_SIZE;
    if (profile < 16) return fl_read_body(&packet->header, frame + FL_HEADER_BYTES, &packet->body);
    const uint8_t *seal = frame + FL_HEADER_BYTES + fl_body_bytes(profile);
    memcpy(packet->sealed_body, frame + FL_HEADER_BYTES, fl_body_bytes(profile));
    packet->counter = fl_get_u4(seal);
    memcpy(packet->tag, seal + 4, 8);
    return FL_OK;
}

/* Write a frame into FL_LARGEST_FRAME_BYTES; returns its size, 0 for a profile that is not listed. */
static inline size_t fl_encode(const struct fl_packet *packet, uint8_t *frame) {
    unsigned profile = packet->header.profile;
    size_t body = fl_body_bytes(profile), size = fl_frame_bytes(profile);
    if (body == 0) return 0;
    fl_put_header(frame, &packet->header);
    if (profile < 16) {
        fl_write_body(profile, &packet->body, frame + FL_HEADER_BYTES);
    } else {
        memcpy(frame + FL_HEADER_BYTES, packet->sealed_body, body);
        fl_put_u4(frame + FL_HEADER_BYTES + body, packet->counter);
        memcpy(frame + FL_HEADER_BYTES + body + 4, packet->tag, 8);
    }
    uint32_t crc = fl_crc32c(frame, size - FL_CRC_BYTES);
    for (size_t i = 0; i < 4; i++) frame[size - 4 + i] = (uint8_t)(crc >> 8 * i);
    return size;
}

/* Write 0x00, COBS, 0x00 into size + size / 254 + 3 bytes; returns how many. */
static inline size_t fl_wrap(const uint8_t *frame, size_t size, uint8_t *line) {
    size_t code = 1, to = 2;
    line[0] = 0;
    for (size_t i = 0; i < size; i++) {
        if (frame[i] != 0) line[to++] = frame[i];
        if (frame[i] == 0 || (to - code == 255 && i + 1 < size)) {
            line[code] = (uint8_t)(to - code);
            code = to++;
        }
    }
    line[code] = (uint8_t)(to - code);
    line[to++] = 0;
    return to;
}

/* Undo COBS between two delimiters, into at most size bytes; returns how many, or 0 for what is not COBS. */
static inline size_t fl_unwrap(const uint8_t *line, size_t size, uint8_t *frame) {
    size_t from = 0, to = 0;
    while (from < size) {
        size_t run = line[from];
        if (run == 0 || from + run > size) return 0;
        for (size_t i = 1; i < run; i++) frame[to++] = line[from + i];
        from += run;
        if (run < 255 && from < size) frame[to++] = 0;
    }
    return to;
}

#endif
