-- Wireshark dissector for Fathomlink frames; see protocol/WIRE.md.
-- Made from protocol/layouts.py by: python -m host_tools.dissector (layout version 1, ed3d91bc69b9bc4e)
-- Use: tshark -X lua_script:fathomlink.lua -V -r capture.pcap, or copy it to Wireshark's plugin folder.
-- Captures by `fathomlink inspect FILE --pcap OUT`: USER0 holds frames, USER1 frames behind three bytes of the
-- simulated medium (source, destination, fate).

local bits = bit or bit32
local flink = Proto("fathomlink", "Fathomlink")

local PROFILES = {
    [1] = "SUBMAP_PAPER",
    [2] = "ANSWER",
    [3] = "TRAJECTORY",
    [4] = "SUBMAP_DENSE",
    [5] = "SUBMAP_LATTICE",
    [6] = "SUBMAP_LATTICE_SMALL",
    [7] = "ANSWER_EXTENDED",
    [8] = "TRAJECTORY_SMALL",
    [17] = "SEALED_SUBMAP_PAPER",
    [18] = "SEALED_ANSWER",
    [19] = "SEALED_TRAJECTORY",
    [20] = "SEALED_SUBMAP_DENSE",
    [21] = "SEALED_SUBMAP_LATTICE",
    [22] = "SEALED_SUBMAP_LATTICE_SMALL",
    [23] = "SEALED_ANSWER_EXTENDED",
    [24] = "SEALED_TRAJECTORY_SMALL",
}
local BODY_BYTES = {
    [1] = 244,
    [2] = 10,
    [3] = 244,
    [4] = 244,
    [5] = 244,
    [6] = 50,
    [7] = 30,
    [8] = 50,
    [17] = 232,
    [18] = 10,
    [19] = 232,
    [20] = 232,
    [21] = 232,
    [22] = 38,
    [23] = 30,
    [24] = 38,
}
local FATES = {
    [0] = "delivered",
    [1] = "lost",
    [2] = "collision",
    [3] = "half-duplex",
    [4] = "corrupt",
    [5] = "duplicate",
    [6] = "out-of-reach",
}

local f = {
    source = ProtoField.uint8("fathomlink.source", "Source node"),
    destination = ProtoField.uint8("fathomlink.destination", "Destination node"),
    fate = ProtoField.uint8("fathomlink.fate", "Fate", base.DEC, FATES),
    version = ProtoField.uint8("fathomlink.version", "Version", base.DEC, nil, 0xE0),
    profile = ProtoField.uint8("fathomlink.profile", "Profile", base.DEC, PROFILES, 0x1F),
    vehicle = ProtoField.uint8("fathomlink.vehicle", "Vehicle (sender)", base.DEC, nil, 0xF0),
    boot_epoch = ProtoField.uint8("fathomlink.boot_epoch", "Boot epoch", base.DEC, nil, 0x0F),
    submap = ProtoField.uint16("fathomlink.submap", "Sub-map"),
    fragment = ProtoField.uint8("fathomlink.fragment", "Fragment", base.DEC, nil, 0xF0),
    fragment_count = ProtoField.uint8("fathomlink.fragment_count", "Fragment count", base.DEC, nil, 0x0F),
    tx_second = ProtoField.uint8("fathomlink.tx_second", "Second of transmission mod 16", base.DEC, nil, 0xF0),
    time_quarters = ProtoField.uint24("fathomlink.time_quarters", "Time in quarter seconds", base.DEC, nil, 0x0FFFFF),
    time_s = ProtoField.double("fathomlink.time_s", "Time in seconds"),
    value = ProtoField.float("fathomlink.value", "Value"),
    number = ProtoField.uint16("fathomlink.number", "Number"),
    body = ProtoField.bytes("fathomlink.body", "Body"),
    counter = ProtoField.uint32("fathomlink.counter", "Counter"),
    tag = ProtoField.bytes("fathomlink.tag", "Tag"),
    crc = ProtoField.uint32("fathomlink.crc", "CRC-32C", base.HEX),
    crc_good = ProtoField.bool("fathomlink.crc.good", "CRC is right"),
}
flink.fields = f
local damaged = ProtoExpert.new("fathomlink.damaged", "Damaged frame", expert.group.CHECKSUM, expert.severity.ERROR)
local foreign = ProtoExpert.new("fathomlink.foreign", "Not a frame", expert.group.MALFORMED, expert.severity.ERROR)
flink.experts = { damaged, foreign }

local function crc32c(tvb)
    local crc = 0xFFFFFFFF
    for i = 0, tvb:len() - 1 do
        crc = bits.bxor(crc, tvb(i, 1):uint())
        for _ = 1, 8 do
            local carry = bits.band(crc, 1)
            crc = bits.rshift(crc, 1)
            if carry == 1 then crc = bits.bxor(crc, 0x82F63B78) end
        end
    end
    return bits.bxor(crc, 0xFFFFFFFF) % 4294967296
end

local function floats(tree, range, name, columns)
    local branch = tree:add(flink, range, name .. " (" .. range:len() / 4 .. " floats)")
    for i = 0, range:len() / 4 - 1 do
        local label = name .. "[" .. i .. "]"
        if #columns > 0 then
            label = name .. "[" .. math.floor(i / #columns) .. "]." .. columns[i % #columns + 1]
        end
        branch:add(f.value, range(4 * i, 4)):prepend_text(label .. " ")
    end
end

local STATE = { "north_m", "east_m", "yaw_rad" }
local POINT = { "north_m", "east_m", "depth_m" }
local HYPER = { "b", "c", "sigma2", "mean_depth_m" }

local BODIES = {
    [1] = function(tree, range)
        floats(tree, range(0, 48), "trajectory", STATE)
        floats(tree, range(48, 180), "points_ned_m", POINT)
        floats(tree, range(228, 16), "hyperparameters", HYPER)
    end,
    [2] = function(tree, range)
        tree:add(f.number, range(0, 2)):prepend_text("submap ")
        tree:add(f.value, range(2, 4)):prepend_text("north_m ")
        tree:add(f.value, range(6, 4)):prepend_text("east_m ")
    end,
    [3] = function(tree, range)
        floats(tree, range(0, 240), "states", STATE)
        tree:add(f.body, range(240, 4)):prepend_text("reserved ")
    end,
    [4] = function(tree, range)
        tree:add(f.body, range(0, 244)):prepend_text("body ")
    end,
    [5] = function(tree, range)
        tree:add(f.body, range(0, 244)):prepend_text("body ")
    end,
    [6] = function(tree, range)
        tree:add(f.body, range(0, 50)):prepend_text("body ")
    end,
    [7] = function(tree, range)
        tree:add(f.number, range(0, 2)):prepend_text("submap ")
        tree:add(f.value, range(2, 4)):prepend_text("north_m ")
        tree:add(f.value, range(6, 4)):prepend_text("east_m ")
        tree:add(f.value, range(10, 4)):prepend_text("variance_m2 ")
        tree:add(f.value, range(14, 4)):prepend_text("leader_north_m ")
        tree:add(f.value, range(18, 4)):prepend_text("leader_east_m ")
        tree:add(f.value, range(22, 4)):prepend_text("leader_variance_m2 ")
        tree:add(f.number, range(26, 2)):prepend_text("repeat_submap ")
        tree:add(f.number, range(28, 2)):prepend_text("missing_fragments ")
    end,
    [8] = function(tree, range)
        floats(tree, range(0, 48), "states", STATE)
        tree:add(f.body, range(48, 2)):prepend_text("reserved ")
    end,
    [17] = function(tree, range)
        floats(tree, range(0, 48), "trajectory", STATE)
        floats(tree, range(48, 168), "points_ned_m", POINT)
        floats(tree, range(216, 16), "hyperparameters", HYPER)
    end,
    [18] = function(tree, range)
        tree:add(f.number, range(0, 2)):prepend_text("submap ")
        tree:add(f.value, range(2, 4)):prepend_text("north_m ")
        tree:add(f.value, range(6, 4)):prepend_text("east_m ")
    end,
    [19] = function(tree, range)
        floats(tree, range(0, 228), "states", STATE)
        tree:add(f.body, range(228, 4)):prepend_text("reserved ")
    end,
    [20] = function(tree, range)
        tree:add(f.body, range(0, 232)):prepend_text("body ")
    end,
    [21] = function(tree, range)
        tree:add(f.body, range(0, 232)):prepend_text("body ")
    end,
    [22] = function(tree, range)
        tree:add(f.body, range(0, 38)):prepend_text("body ")
    end,
    [23] = function(tree, range)
        tree:add(f.number, range(0, 2)):prepend_text("submap ")
        tree:add(f.value, range(2, 4)):prepend_text("north_m ")
        tree:add(f.value, range(6, 4)):prepend_text("east_m ")
        tree:add(f.value, range(10, 4)):prepend_text("variance_m2 ")
        tree:add(f.value, range(14, 4)):prepend_text("leader_north_m ")
        tree:add(f.value, range(18, 4)):prepend_text("leader_east_m ")
        tree:add(f.value, range(22, 4)):prepend_text("leader_variance_m2 ")
        tree:add(f.number, range(26, 2)):prepend_text("repeat_submap ")
        tree:add(f.number, range(28, 2)):prepend_text("missing_fragments ")
    end,
    [24] = function(tree, range)
        floats(tree, range(0, 36), "states", STATE)
        tree:add(f.body, range(36, 2)):prepend_text("reserved ")
    end,
}

local function dissect(tvb, pinfo, root)
    pinfo.cols.protocol = "Fathomlink"
    local tree = root:add(flink, tvb())
    if tvb:len() < 12 then
        tree:add_proto_expert_info(foreign, "shorter than any frame")
        pinfo.cols.info = tvb:len() .. " bytes, shorter than any frame"
        return
    end
    local profile = bits.band(tvb(0, 1):uint(), 31)
    local name = PROFILES[profile] or ("profile " .. profile)
    tree:add(f.version, tvb(0, 1))
    tree:add(f.profile, tvb(0, 1))
    tree:add(f.vehicle, tvb(1, 1))
    tree:add(f.boot_epoch, tvb(1, 1))
    tree:add(f.submap, tvb(2, 2))
    tree:add(f.fragment, tvb(4, 1))
    tree:add(f.fragment_count, tvb(4, 1))
    tree:add(f.tx_second, tvb(5, 1))
    tree:add(f.time_quarters, tvb(5, 3))
    tree:add(f.time_s, tvb(5, 3), bits.band(tvb(5, 3):uint(), 0xFFFFF) / 4):set_generated()

    local body, seal = BODY_BYTES[profile], profile >= 16 and 12 or 0
    if body and tvb:len() == 8 + body + seal + 4 then
        BODIES[profile](tree, tvb(8, body))
        if seal > 0 then
            tree:add(f.counter, tvb(8 + body, 4))
            tree:add(f.tag, tvb(12 + body, 8))
        end
    else
        tree:add_proto_expert_info(foreign, "not the size of " .. name)
    end

    local at = tvb:len() - 4
    local right = crc32c(tvb(0, at):tvb()) == tvb(at, 4):le_uint()
    tree:add_le(f.crc, tvb(at, 4))
    tree:add(f.crc_good, tvb(at, 4), right):set_generated()
    if not right then tree:add_proto_expert_info(damaged, "the CRC is wrong") end
    pinfo.cols.info = string.format("%s vehicle %d, fragment %d of sub-map %d%s", name,
        bits.rshift(tvb(1, 1):uint(), 4), bits.rshift(tvb(4, 1):uint(), 4), tvb(2, 2):uint(),
        right and "" or " [CRC wrong]")
end

function flink.dissector(tvb, pinfo, root)
    dissect(tvb, pinfo, root)
end

local air = Proto("fathomlink_air", "Fathomlink on the simulated air")
function air.dissector(tvb, pinfo, root)
    if tvb:len() < 3 then return end
    local tree = root:add(air, tvb(0, 3))
    tree:add(f.source, tvb(0, 1))
    tree:add(f.destination, tvb(1, 1))
    tree:add(f.fate, tvb(2, 1))
    pinfo.cols.src = "node " .. tvb(0, 1):uint()
    pinfo.cols.dst = "node " .. tvb(1, 1):uint()
    dissect(tvb(3):tvb(), pinfo, root)
end

local encapsulations = DissectorTable.get("wtap_encap")
encapsulations:add(wtap.USER0, flink)
encapsulations:add(wtap.USER1, air)
